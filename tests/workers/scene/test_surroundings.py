"""Surroundings of a scene: colours by hue, pictures by metres, walls and clutter; what they change, and what they must not."""

import colorsys
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from schemas.base import Range
from schemas.errors import AssetSourceError, JobError, MeshError, StartError, ViewError
from schemas.job.job import job_digest
from schemas.job.look import Palette, Room, Surface
from schemas.scene.shape import REGION_FIRST_CLUTTER, REGION_FIRST_OBJECT, REGION_FLOOR, Part
from schemas.scene.view import MODALITIES
from services.job.job_file import load_job, validate_job
from services.job.record import decode_job, encode_job, record_job
from tests.effects.cases import ABOVE_THE_HORIZON, PICTURES
from tests.effects.scenes import Made, Setting, facts_of, make
from workers.assets.look.pictures import KEPT_PX, LARGEST_PX, load_picture, open_pictures
from workers.assets.look.recolour import palette_rows, recolour_colour, recolour_texture
from workers.assets.look.surroundings import build_room, cover_floor, cover_table, draw_coat
from workers.capture.results import open_sources
from workers.geometry.camera import unproject
from workers.geometry.pixels import fill_image

RNG = np.random.default_rng


def hue_of(colours: np.ndarray) -> np.ndarray:
    return np.array([colorsys.rgb_to_hsv(*colour)[0] for colour in colours])


def test_each_hue_goes_into_the_nearest_range_in_order_greys_stay_and_saturation_is_bounded():
    palette = Palette(hue=((0.1, 0.2), (0.55, 0.6), (0.95, 1.0)), saturation=(0.2, 0.6))
    rows, hues = palette_rows(palette), np.linspace(0.0, 1.0, 500, endpoint=False)
    assert rows is not None
    for saturation, value in ((0.9, 0.8), (0.15, 0.5)):
        before = [colorsys.hsv_to_rgb(hue, saturation, value) for hue in hues]
        after = np.array([recolour_colour(*colour, rows) for colour in before])
        hue = hue_of(after)
        ends = np.array(palette.hue)
        away = np.abs((hue[:, None, None] - ends + 0.5) % 1.0 - 0.5)
        inside = ((hue[:, None] >= ends[:, 0] - 1e-9) & (hue[:, None] <= ends[:, 1] + 1e-9)) | (away.min(axis=2) < 1e-9)
        assert inside.any(axis=1).all()
        nearest = np.abs((hues[:, None, None] - ends + 0.5) % 1.0 - 0.5).min(axis=2)
        within = (hues[:, None] >= ends[:, 0]) & (hues[:, None] <= ends[:, 1])
        expected = np.where(within, -1.0, nearest).argmin(axis=1)
        clear = np.sort(np.where(within, -1.0, nearest), axis=1)
        apart = clear[:, 1] - clear[:, 0] > 1e-9
        assert inside[np.arange(500), expected][apart].all()
        turned = (hue - 0.9) % 1.0
        order = np.argsort((hues - 0.775) % 1.0)  # half-way between the last two ranges
        assert (np.diff(turned[order]) > -1e-9).all()
        most = np.array([colorsys.rgb_to_hsv(*colour)[1] for colour in after]).max()
        assert most == pytest.approx(0.2 + 0.4 * (0.9 - 0.2) / 0.8 if saturation > 0.2 else saturation)
    greys = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)[None]
    assert np.array_equal(recolour_texture(greys, rows), greys)
    texels = RNG(1).integers(0, 256, (40, 50, 4), np.uint8)
    single = [np.rint(255 * np.array(recolour_colour(*(texel[:3] / 255.0), rows))) for texel in texels.reshape(-1, 4)]
    changed = recolour_texture(texels, rows)
    assert np.array_equal(changed[..., :3].reshape(-1, 3), single)
    assert np.array_equal(changed[..., 3], texels[..., 3])


SURFACES = {"floor": {"folder": PICTURES, "tile_m": [0.7, 0.9]}, "table": {"colours": [[0.1, 0.7, 0.2]]}}


def files_of(made: Made, word: str) -> dict[str, str]:
    return {path: digest for path, digest in made.files.items() if path.split("/")[-1].startswith(word)}


def test_colour_of_surroundings_changes_rgb_alone_and_no_row_but_what_was_drawn():
    plain = make(Setting({}))
    made = make(Setting({"look": {**SURFACES, "recolour": "packaging", "background": PICTURES}}))
    for kind in MODALITIES.values():
        for word in {kind.word} - {MODALITIES["rgb"].word}:
            assert files_of(made, word) == files_of(plain, word)
    assert all(files_of(made, "RGB")[path] != digest for path, digest in files_of(plain, "RGB").items())
    (row,), (before,) = made.rows["scenes"], plain.rows["scenes"]
    assert {**row, "surroundings": None} == before
    drawn: Any = row["surroundings"]
    assert (drawn["table"], drawn["table_tile_m"], drawn["room_m"]) == ("[0.1, 0.7, 0.2]", None, None)
    assert 0.7 <= drawn["floor_tile_m"] <= 0.9
    assert (Path(PICTURES) / drawn["floor"]).is_file() and (Path(PICTURES) / drawn["background"]).is_file()
    assert made.rows["assets"][0] == plain.rows["assets"][0]  # the table's shape is stored as it is made


def test_pictures_repeat_after_their_metres_on_every_face_and_no_face_is_moved():
    plan, surface = facts_of(Setting({})).plan, Surface(folder=PICTURES, tile_m=(0.3, 0.5))
    look = validate_job({"name": "x", "look": {"floor": {"folder": PICTURES}}}, "x").look
    coat = draw_coat(surface, open_pictures(look, Path())["look.floor.folder"], RNG(3), 0.9)
    texture = coat.material.texture
    assert texture is not None and max(texture.shape) <= KEPT_PX
    assert coat.tile_m[1] / coat.tile_m[0] == pytest.approx(texture.shape[0] / texture.shape[1])
    table = plan.table.asset.shape
    for before, after in ((plan.floor, cover_floor(plan.floor, coat)), (table, cover_table(plan.table.asset, coat))):
        assert np.array_equal(after.vertices[after.faces], before.vertices[before.faces])
        for part in (part for part in after.parts if part.material is coat.material):
            _is_metric(part, coat.tile_m)


def _is_metric(part: Part, tile_m: np.ndarray) -> None:
    """Each edge of a face is as long on the picture as it is where it is seen along the axis that the face looks along most."""
    assert part.uv is not None
    corners, uv = part.vertices[part.faces], part.uv[part.faces] * tile_m
    edges, flat = corners - np.roll(corners, 1, axis=1), uv - np.roll(uv, 1, axis=1)
    axis = np.abs(np.cross(edges[:, 0], edges[:, 1])).argmax(axis=1)
    edges[np.arange(len(edges)), :, axis] = 0.0
    assert np.allclose(np.linalg.norm(edges, axis=2), np.linalg.norm(flat, axis=2), atol=1e-9)


def test_a_room_is_seen_where_rays_meet_it_and_its_window_is_on_the_key_lights_side():
    far: dict[str, Any] = {
        **ABOVE_THE_HORIZON,
        "images": {"depth_range_m": [0.2, 9.0]},
        "check": {"raycast_share": 1.0},
    }
    room = {"room": {"size_m": [6.0, 6.4], "height_m": [1.2, 1.4]}}
    made = make(Setting({**far, "look": room}))  # raises where depth or masks are not those of rays
    view, (row,) = made.scene.pairs[0].input, made.rows["scenes"]
    length, width, height = row["surroundings"]["room_m"]
    assert view.region is not None
    pixels = np.nonzero((view.region == REGION_FLOOR) & (view.depth > 0))
    points = unproject(*pixels, view.depth[pixels] / 5000.0, view.camera.intrinsics) @ view.camera.T_world_cam[:3, :3].T
    points += view.camera.position
    up = points[:, 2] > 0.05
    assert up.any() and points[:, 2].max() < height + 0.01
    outside = np.abs(points[up, :2]) - 0.5 * np.array([length, width])
    assert (np.abs(outside).min(axis=1) < 0.15).all() and outside.max() < 0.12
    for azimuth in np.linspace(0.1, 2.0 * np.pi, 16):
        light = np.array([np.cos(azimuth), np.sin(azimuth), 1.0])
        walls = build_room(Room(size_m=Range(6.0, 6.0)), light, RNG(7))
        (pane,) = (part for part in walls.shape.parts if part.name == "window")
        middle = pane.vertices.mean(axis=0)[:2]
        assert middle @ light[:2] / np.linalg.norm(middle) > 0.97  # a corner's is 12 degrees aside
    plain = make(Setting(far)).scene.pairs[0].input
    assert plain.region is not None
    things = plain.region > REGION_FLOOR
    assert np.array_equal(view.region[things], plain.region[things])
    assert np.array_equal(view.depth[things], plain.depth[things])


@pytest.mark.parametrize(
    ("size_m", "error", "message"),
    [(1.0, StartError, r"the table reaches \S+ m beyond a room of 1.00 x 1.00 m: raise look.room.size_m"),
     (2.5, ViewError, r"the input camera stands \S+ m too far out for a room of 2.50 x 2.50 m")],
)  # fmt: skip
def test_a_room_that_the_table_or_a_camera_does_not_fit_into_is_a_failure_with_the_figure(size_m, error, message):
    with pytest.raises(error, match=message):
        make(Setting({"look": {"room": {"size_m": [size_m, size_m]}}}))


ALL_TARGETS = {"views": ["normals", "coordinates", "albedo", "covisible", "amodal", "layers"]}


@pytest.mark.minute
def test_clutter_is_in_images_masks_and_depth_and_has_no_row():
    clutter: dict[str, Any] = {"clutter": {"count": 3, "categories": ["box"]}}
    changes = {"targets": ALL_TARGETS, "check": {"raycast_share": 1.0}, "objects_per_scene": 2}
    plain, made = make(Setting(changes)), make(Setting({**changes, "look": clutter}))
    drawn: Any = made.rows["scenes"][0]["surroundings"]
    ids = [body["region_id"] for body in drawn["clutter"]]
    assert ids == [REGION_FIRST_CLUTTER + n for n in range(3)]
    assert {body["category"] for body in drawn["clutter"]} == {"box"}
    regions = set(np.unique(np.stack([view.region for view in made.scene.pairs[0].views if view.region is not None])))
    assert regions & set(ids)
    for table in ("views", "objects", "scenes"):
        for row in made.rows[table]:
            assert not {row.get("region_id"), *(body["region_id"] for body in row.get("bodies", ()))} & set(ids)
    assert len(made.rows["objects"]) == len(plain.rows["objects"])
    assert {path.split("/")[-1] for path in made.files} >= {path.split("/")[-1] for path in plain.files}
    starts = [made.scene.plan.objects, plain.scene.plan.objects]
    for one, other in zip(*starts, strict=False):
        assert one.asset.instance_id == other.asset.instance_id
    first = made.scene.pairs[0].input
    assert first.region is not None
    of_clutter = first.region >= REGION_FIRST_CLUTTER
    for kind in ("coordinates", "amodal"):
        shown = first.further[kind][..., of_clutter] if kind == "amodal" else first.further[kind][of_clutter]
        assert kind == "amodal" or not shown.any()
    z = first.depth[(first.region >= REGION_FIRST_OBJECT) & ~of_clutter & (first.depth > 0)]
    assert made.scene.pairs[0].d_z_m == pytest.approx(np.percentile(z, 2) / 5000.0, abs=2e-3)


def test_clutter_that_finds_no_room_is_left_out_and_the_rest_is_made():
    changes: dict[str, Any] = {"start": {"offset_m": [-0.12, 0.12]}, "look": {"clutter": {"count": 30}}}
    made = make(Setting(changes))
    assert 0 <= len(made.scene.plan.objects) - 1 < 12
    tight: dict[str, Any] = {"start": {"offset_m": [0.0, 0.0]}, "look": {"clutter": {"count": 3}}}
    none = make(Setting(tight)).scene.effects
    assert none.skipped["clutter"] == "none of it found room"


def _picture(kind: str, size: tuple[int, int]) -> bytes:
    out = BytesIO()
    Image.fromarray(RNG(5).integers(0, 256, (size[1], size[0], 3), np.uint8)).save(out, kind)
    return out.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [("notes.txt", b"hello", r"has 0 pictures \(.jpg, .jpeg, .png\): give 1 to"),
     ("a.png", b"hello", r"a.png is no picture that can be read"),
     ("a.png", b"", r"a.png is no picture that can be read"),
     ("a.jpg", _picture("JPEG", (300, 200))[:9000], r"a.jpg cannot be read: .*truncated"),
     ("a.png", _picture("PNG", (300, 200))[:9000], r"a.png cannot be read"),
     ("a.png", _picture("PNG", (LARGEST_PX + 1, 2)), rf"is {LARGEST_PX + 1} x 2, and at most {LARGEST_PX} a side are read")],
)  # fmt: skip
def test_a_folder_without_pictures_or_with_a_broken_one_is_refused_with_its_key(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    job = validate_job({"name": "x", "look": {"table": {"folder": str(tmp_path)}}}, "x")
    with pytest.raises(AssetSourceError, match=rf"look.table.folder: .*{message}"):
        open_sources(job, Path())
    flat = job.model_copy(update={"render": job.render.model_copy(update={"tier": "flat"})})
    assert open_sources(flat, Path()).pictures == {}  # not drawn, not read


def test_pictures_are_turned_upright_reduced_and_part_of_what_decides_a_scene(tmp_path):
    pixels = np.zeros((1100, 2200, 3), np.uint8)
    pixels[:, :1100] = 255
    turned, at = Image.Exif(), tmp_path / "below"
    turned[0x0112] = 6  # to be turned by a quarter clockwise
    for folder in (at, tmp_path / ".thumbnails"):
        folder.mkdir()
        Image.fromarray(pixels).save(folder / "a.jpg", exif=turned)
    (at / "._a.jpg").write_bytes(b"of another system, beside a.jpg")  # hidden files are no pictures
    job = validate_job({"name": "x", "look": {"background": str(tmp_path)}}, "x")
    before = open_sources(job, Path())
    ((picture,),) = before.pictures.values()
    assert picture.name == "below/a.jpg"
    texture = load_picture(picture)
    assert texture.shape == (KEPT_PX, KEPT_PX // 2, 3)
    assert texture[:400].min() > 250 and texture[-400:].max() < 5
    assert fill_image(texture, 64, 48).shape == (48, 64, 3)
    Image.fromarray(pixels).save(at / "a.jpg")
    assert (
        open_sources(job, Path()).digest
        != before.digest
        != open_sources(validate_job({"name": "x"}, "x"), Path()).digest
    )
    load_picture.cache_clear()
    for change, message in ((lambda: None, "does not hold what it held"), ((at / "a.jpg").unlink, "a.jpg")):
        change()
        with pytest.raises(MeshError, match=message) as raised:
            load_picture(picture)
        assert raised.value.kind == "environmental", "made from the job and its seed with the file of before"


@pytest.mark.parametrize(
    ("keys", "message"),
    [({"look": {"floor": {}}}, "needs either a folder of pictures or colours"),
     ({"look": {"floor": {"colours": [[0.1, 0.2, 1.3]]}}}, "look.floor.colours.0.2: 1.3: must be at most 1"),
     ({"look": {"floor": {"folder": "x", "tile_m": [0.0, 1.0]}}}, "must lie within 0.01 and 100"),
     ({"look": {"recolour": "neon"}}, "must be 'as_made' or 'packaging'"),
     ({"look": {"recolour": {"hue": [[0.5, 0.6], [0.1, 0.2]]}}}, "ranges of hue must ascend"),
     ({"look": {"clutter": {"count": 51}}}, "write a whole number from 1 to 50"),
     ({"look": {"room": {"size_m": [0.5, 3]}}}, "must lie within 1 and 59"),
     ({"scene": "studio", "look": {"room": True}}, "scene is studio, and look.room is given"),
     ({"scene": "studio", "look": {"background": "x"}}, "studio.background is transparent, and look.background is given"),
     ({"captures": {}, "look": {"clutter": {}}}, "look.clutter is given: leave it out, of look a virtual capture has"),
     ({"captures": {"folders": ["x"]}, "look": {"room": True}}, "look.room is given: leave it out, photographs show")],
)  # fmt: skip
def test_surroundings_that_cannot_be_are_refused_by_their_key(keys, message):
    with pytest.raises(JobError, match=message):
        validate_job({"name": "x", **keys}, "x")


def test_a_room_is_a_switch_and_where_pictures_lie_decides_nothing():
    job, other = (validate_job({"name": "x", "look": {"room": True, "floor": {"folder": name}}}, "x") for name in "ab")
    assert job.look.room == Room() and validate_job({"name": "x", "look": {"room": False}}, "x").look.room is None
    assert job_digest(job, "c") == job_digest(other, "c") != job_digest(validate_job({"name": "x"}, "x"), "c")


@pytest.mark.parametrize(
    ("text", "recolour"),
    [("", "packaging"), ("look: {room: true}", "packaging"), ("look: {recolour: as_made}", "as_made"),
     ("assets: {objects: [{source: library, folder: x}, {source: procedural}]}", "packaging"),
     ("assets: {objects: [{source: library, folder: x}]}", "as_made")],
)  # fmt: skip
def test_a_new_job_of_built_in_objects_has_the_colours_of_packaging_and_an_older_record_has_not(
    tmp_path, text, recolour
):
    (tmp_path / "a.yaml").write_text(f"name: x\n{text}\n")
    job = load_job(tmp_path / "a.yaml")
    assert job.look.recolour == recolour
    record = record_job(job, "c", tmp_path)
    assert decode_job(encode_job(record), "job.yaml").job.look == job.look
    older = (
        encode_job(record_job(validate_job({"name": "x"}, "x"), "c", tmp_path))
        .decode()
        .replace("recolour: as_made", "")
    )
    assert decode_job(older.encode(), "job.yaml").job.look.recolour == "as_made"

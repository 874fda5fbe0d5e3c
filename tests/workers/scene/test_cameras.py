"""Further cameras and studio scenes: labels by cast rays, disparity, symmetry, sizes, and what one entry leaves of another."""

import contextlib
import dataclasses
import io
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
import trimesh

from schemas.errors import AssetSourceError, ViewError
from schemas.scene.scene import ScenePlan
from schemas.scene.view import Camera, Intrinsics
from services.read.audit import verify_independently
from services.read.dataset_reader import find_scene
from tests.datasets import faults_of, make_dataset, overlaid
from tests.effects.scenes import Setting, context_of, make
from tests.kit.shapes import asset_of, box
from workers.assets.poses import open_poses, poses_of, read_poses
from workers.capture.results import open_sources
from workers.geometry.camera import look_at
from workers.geometry.frames import translation
from workers.geometry.hull import hull_of
from workers.scene.cameras import IN_TABLE, require_room, things_of
from workers.scene.draw.studio import scaled_to
from workers.scene.make_scene import make_scene
from workers.stopwatch import Stopwatch

BAND = [0.35, 1.3]
ABOVE: dict[str, dict[str, Any]] = {
    "ring": {
        "ring": {"count": 3, "inclination_rad": BAND, "start": "input", "radius_m": [0.9, 1.5]},
        "roll_deg": [-90, 90],
    },
    **{
        pattern: {"sphere": {"count": 3, "pattern": pattern, "inclination_rad": BAND}}
        for pattern in ("hammersley", "fibonacci", "trellis")
    },
    **{
        pattern: {"sphere": {"count": 3, "pattern": pattern, "inclination_rad": BAND, "radius_m": [1.0, 2.0]}}
        for pattern in ("uniform", "cube")
    },
    "stereo": {"beside": "input", "offset_m": [0.06, 0.0, 0.0]},
    "poses": {"poses": "poses.json"},
    "syncdreamer": {"preset": "syncdreamer"},
}
"""Entries of each kind, all above a table."""
AROUND = (
    ABOVE
    | {name: {"preset": name} for name in ("zero123", "zero123plus", "lrm", "trellis")}
    | {"everywhere": {"sphere": {"count": 4, "pattern": "fibonacci"}}}
)
SMALL_SENSOR = {"width": 64, "height": 48, "fx": 52.5, "fy": 52.5, "cx": 32.0, "cy": 24.0}
SCENES = [2, pytest.param(100, marks=pytest.mark.slow)]


def write_poses(folder: Path) -> str:
    """A table of two poses of the world, above the table's top and aside of its middle."""
    poses = [look_at(np.array([x, 0.9, 1.6]), np.array([0.0, 0.05, 0.6])).ravel().tolist() for x in (-0.4, 0.7)]
    path = folder / "poses.json"
    path.write_text(json.dumps([{"T_world_cam": T} for T in poses]))
    return str(path)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("scenes", SCENES)
@pytest.mark.parametrize(
    ("scene", "kinds"), [("tabletop", ABOVE), pytest.param("studio", AROUND, marks=pytest.mark.minute)]
)
def test_every_view_of_every_kind_shows_what_rays_meet_and_verifies(tmp_path, scene, kinds, scenes):
    """No failures: the check of every scene by cast rays, which a wrong label fails, is one of those that make it a failure."""
    poses = write_poses(tmp_path)
    more = [
        entry | {"name": f"cam-{kind}"} | ({"poses": poses} if kind == "poses" else {}) for kind, entry in kinds.items()
    ]
    job = {"scene": scene, "scenes": scenes, "check": {"raycast_share": 1.0}, "images": {"depth_range_m": [0.05, 13.0]}}
    job |= {"studio": {"scale": "unit_sphere", "size_m": 0.5}} if scene == "studio" else {}  # all views have depth
    store, _ = make_dataset(tmp_path / "out", **job, cameras={"more": more, "sensor": SMALL_SENSOR})
    stored = [find_scene(store, scene_id) for scene_id in range(scenes)]
    assert not [row for each in stored for row in each.rows["failures"]]
    assert all(row["raycast_checked"] for each in stored for row in each.rows["scenes"])
    assert faults_of(store) == []
    verdict = verify_independently(store, min(scenes, 4), lambda _: None)
    assert verdict.faults == []
    assert {view["role"] for view in stored[0].rows["views"]} >= {entry["name"] for entry in more}


def alone(mesh: trimesh.Trimesh, **changes: Any) -> Setting:
    """A studio scene of this mesh."""

    def edit(plan: ScenePlan) -> ScenePlan:
        asset = asset_of(mesh)
        start = dataclasses.replace(plan.objects[0], asset=asset, hull=hull_of(asset.shape))
        return dataclasses.replace(plan, objects=(start,))

    return Setting(overlaid({"scene": "studio", "images": {"depth_range_m": [0.05, 13.0]}}, changes), edit)


UNITS = 65_000.0


def test_disparity_of_a_stereo_pair_is_the_distance_between_images_of_a_point():
    """fx b / z is linear on a plane's image: between two pixels of the other view it is what lies between theirs."""
    more = [{"name": "right", "beside": "input", "offset_m": [0.06, 0.0, 0.0]}]
    images = {"depth_units_per_m": UNITS, "depth_range_m": [0.05, 1.0]}
    made = make(alone(box(0.2, 0.15, 0.2), cameras={"more": more}, images=images))
    (left, right) = (view for _, view in made.scene.views())
    k, worst, count = left.camera.intrinsics, 0.0, 0
    disparity = [np.where(v.depth > 0, k.fx * 0.06 * UNITS / np.maximum(v.depth, 1), np.nan) for v in (left, right)]
    for row, column in np.argwhere(left.region > 0):
        u = column - disparity[0][row, column]
        first, share = math.floor(u), u - math.floor(u)
        if not 1 <= first < k.width - 3:
            continue
        around = disparity[1][row, first - 1 : first + 3]
        if np.isnan(around).any() or np.abs(np.diff(around, n=2)).max() > 5e-4:
            continue  # an edge of the box
        between = (1.0 - share) * around[1] + share * around[2]
        worst, count = max(worst, abs(between - disparity[0][row, column])), count + 1
    assert count > 500 and worst < 1e-3


def test_views_of_a_ring_are_alike_for_a_body_of_revolution():
    mesh = trimesh.creation.cylinder(radius=0.2, height=0.5, sections=24)
    more = [{"name": "around", "ring": {"count": 8, "inclination_rad": 0.5, "radius_m": 1.2}}]
    made = make(alone(mesh, cameras={"more": more}, render={"tier": "flat"}))
    views = [view for _, view in made.scene.views() if view.role == "around"]
    first = views[0]
    assert len(views) == 8 and np.count_nonzero(first.region) > 1000
    for view in views[1:]:
        assert np.count_nonzero(view.region != first.region) <= 2  # roundings at the outline
        both = (view.region > 0) & (first.region > 0)
        assert np.abs(view.depth[both].astype(int) - first.depth[both].astype(int)).max() <= 1
    assert not np.array_equal(first.camera.T_world_cam, views[1].camera.T_world_cam)


@pytest.mark.parametrize("scale", ["unit_sphere", "unit_cube"])
def test_a_scaled_object_has_just_that_size_in_its_file_and_its_row(tmp_path, scale):
    stored = {}
    for kind in ("metric", scale):
        studio = {"scale": kind, "size_m": 0.7} if kind != "metric" else {}
        store, _ = make_dataset(tmp_path / kind, scene="studio", scenes=1, categories=["mug"], studio=studio)
        rows = find_scene(store, 0).rows
        mesh = trimesh.load_mesh(io.BytesIO(store.read(f"assets/mug/{rows['scenes'][0]['instance_id']}.glb")), "glb")
        stored[kind] = (
            np.asarray(mesh.vertices),
            rows["scenes"][0]["object_scale"],
            rows["scenes"][0]["bodies"][0]["mass_kg"],
        )
    (before, scale_before, mass_before), (points, scale_now, mass_now) = stored["metric"], stored[scale]
    reach = np.linalg.norm(points, axis=1).max() if scale == "unit_sphere" else np.ptp(points, axis=0).max()
    assert reach == pytest.approx(0.7, rel=1e-6)
    factor = scale_now / scale_before
    assert np.allclose(points, factor * before, rtol=0.0, atol=1e-6)
    assert mass_now == pytest.approx(mass_before * factor**3, rel=1e-9)
    T, asset = np.eye(4), asset_of(box(0.1, 0.2, 0.4))
    T[:3, 3] = 1.0, 2.0, 3.0
    grown = scaled_to(dataclasses.replace(asset, T_source_to_object=T), make_studio("unit_cube"))
    assert (grown.shape.vertices == 2.5 * asset.shape.vertices).all() and grown.volume_m3 == pytest.approx(0.125)
    assert (grown.T_source_to_object[:3, 3] == [2.5, 5.0, 7.5]).all() and grown.scale == 2.5


def make_studio(scale: str) -> Any:
    """The branch `studio` of a job."""
    return Setting({"scene": "studio", "studio": {"scale": scale}}).job.studio


def test_entries_change_no_byte_of_one_another_or_of_pairs():
    entries = [
        {"name": "around", "ring": {"count": 2, "inclination_rad": BAND, "radius_m": [0.9, 1.5]}, "roll_deg": [0, 90]},
        {"name": "over", "sphere": {"count": 2, "pattern": "uniform", "inclination_rad": BAND}},
        {"name": "right", "beside": "mirror", "offset_m": [0.06, 0.0, 0.0]},
    ]
    noisy = {"sensor": {"depth_noise": {}, "rgb_noise": {}}}
    none, all_of_them, turned = (
        make(Setting({**noisy, "cameras": {"more": more}})).files for more in ([], entries, entries[::-1])
    )
    assert all_of_them == turned and none.items() <= all_of_them.items()
    for entry in entries:
        single = make(Setting({**noisy, "cameras": {"more": [entry]}})).files
        assert single.items() <= all_of_them.items()
        assert any(f"_{entry['name']}_" in path for path in single)


def poses_file(folder: Path, name: str, content: object) -> str:
    """A table of this content: text, bytes, rows of JSON, or an Arrow table."""
    path = folder / name
    if isinstance(content, pa.Table):
        pq.write_table(content, path)
    elif content is not None:
        text = content if isinstance(content, str | bytes) else json.dumps(content)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return str(path)


STANDING = np.eye(4)
STANDING[2, 3] = 2.0


def row(change: tuple[int, int, float] | None = None, /, **more: object) -> dict[str, object]:
    """A row of a table, with one number changed."""
    T = STANDING.copy()
    if change is not None:
        T[change[:2]] = change[2]
    return {"T_world_cam": T.ravel().tolist(), **more}


HEAD = ",".join(f"T{i}{j}" for i in range(4) for j in range(4))
PINHOLE = {"fx": 50, "fy": 50, "cx": 32, "cy": 24, "width": 64, "height": 48}
BAD_POSES: dict[str, tuple[object, str]] = {
    "nan.json": ([row(), row((0, 3, math.nan))], "row 1: the pose holds something that is no finite number"),
    "mirror.json": ([row((0, 0, -1.0))], "row 0: the pose mirrors"),
    "scaled.json": ([row((0, 0, 1.1))], "row 0: the pose is no rotation"),
    "last.json": ([row((3, 2, 1.0))], "row 0: the pose does not end in the row 0 0 0 1"),
    "far.json": ([row((0, 3, 1e9))], "row 0: the pose is more than 1000 m away"),
    "ragged.json": ([row(), {"T_world_cam": [1, 2]}], "row 1: T_world_cam is [1.0, 2.0], and must be sixteen numbers"),
    "nested.json": (
        [{"T_world_cam": [[1, 0, 0, 0], [0, 1, 0]]}],
        "row 0: T_world_cam is [[1, 0, 0, 0], [0, 1, 0]], and",
    ),
    "null.parquet": (pa.table({"T_world_cam": pa.array([None], pa.list_(pa.float64()))}), "row 0: T_world_cam is None"),
    "missing.json": ([row(scene_id=0)], "1 of 2 scenes have no row, the first is 1: add theirs"),
    "half.json": ([row(scene_id=0.5)], "row 0: scene_id is 0.5, and must be a whole number"),
    "late.csv": (
        "\n".join(["scene_id," + HEAD, *["1," + ",".join(map(str, STANDING.ravel()))] * 20_000, "-1,1" + 15 * ",0"]),
        "row 20000: scene_id is -1, and must be from 0",
    ),
    "both.json": ([row(T_obj_cam=[0.0] * 16)], "has the columns T_world_cam and T_obj_cam: give one of them"),
    "part.json": ([row(fx=100)], "has the columns fx: give all of"),
    "pixels.json": ([row(**PINHOLE | {"width": 10.5})], "row 0: width is 10.5, and must be a whole number"),
    "large.json": ([row(**PINHOLE | {"height": 5000})], "row 0: height is 5000, and must be from 1 to 4096"),
    "focal.json": ([row(**PINHOLE | {"fy": 0})], "row 0: fy is 0, and must be from 0.001"),
    "many.json": ([row()] * 1001, "every scene has 1001 rows, and must have 1 to 1000"),
    "other.csv": ("b,a\n1,2\n", "its columns are b, a"),
    "text.csv": (f"{HEAD}\n{','.join(['x'] * 16)}\n", "CSV conversion error to double: invalid value 'x'"),
    "cut.csv": (f"{HEAD}\n1,2\n", "CSV parse error"),
    "rowless.csv": (f"{HEAD}\n", "has no rows"),
    "empty.json": ("", "Expecting value"),
    "rowless.json": ("[]", "has no rows"),
    "tree.json": ("{}", "is no list of rows"),
    "deep.json": ("[" * 100_000, "maximum recursion depth"),
    "bytes.json": (b'["\xff"]', "can't decode"),
    "cut.parquet": (b"PAR1", "Parquet"),
    "poses.txt": ("1", "its name ends in .txt: .csv, .parquet and .json are read"),
    "absent.csv": (None, "absent.csv cannot be read: No such file"),
}


@pytest.mark.parametrize("name", BAD_POSES)
def test_a_table_of_poses_that_cannot_be_used_is_refused_by_row_and_value(tmp_path, name):
    content, told = BAD_POSES[name]
    job = Setting({"scenes": 2, "cameras": {"more": [{"name": "a", "poses": poses_file(tmp_path, name, content)}]}}).job
    with pytest.raises(AssetSourceError) as caught:
        open_sources(job, tmp_path)
    line = str(caught.value)
    assert line.startswith("cameras.more.0.poses: ") and name in line and told in line and "\n" not in line, line


def test_a_table_of_poses_is_read_alike_in_every_form_and_its_digest_is_in_the_sources(tmp_path):
    T = [look_at(np.array([x, 0.9, 1.6]), np.zeros(3)) for x in (-0.4, 0.7)]
    lines = "\n".join([HEAD, *(",".join(map(repr, each.ravel().tolist())) for each in T)])
    forms = {
        "flat.json": [{"T_world_cam": each.ravel().tolist()} for each in T],
        "text.json": [{"T_world_cam": json.dumps(each.tolist())} for each in T],
        "a.csv": lines,
        "a.parquet": pa.table({"T_world_cam": [each.ravel().tolist() for each in T]}),
    }
    digests = set()
    for name, content in forms.items():
        job = Setting({"cameras": {"more": [{"name": "a", "poses": poses_file(tmp_path, name, content)}]}}).job
        catalogue = open_sources(job, tmp_path)
        digests.add(catalogue.digest)
        assert np.abs(read_poses(catalogue.poses["a"], 0).T - T).max() < 1e-12
    poses_file(tmp_path, "a.csv", lines.replace("1.6", "1.7"))
    job = Setting({"cameras": {"more": [{"name": "a", "poses": str(tmp_path / "a.csv")}]}}).job
    assert len(digests | {open_sources(job, tmp_path).digest}) == len(forms) + 1


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_of_a_long_table_the_rows_of_a_few_scenes_alone_are_kept_in_their_order(tmp_path, kind):
    """Row n is of scene n mod 130, n mm up, so that each scene has rows all over the table."""
    count = 40_000
    table = {f"T{i}{j}": np.full(count, STANDING[i, j]) for i in range(4) for j in range(4)}
    table |= {"T23": np.arange(count) / 1e3, "scene_id": np.arange(count) % 130}
    write = {"csv": pa.csv.write_csv, "parquet": pq.write_table}[kind]
    write(pa.table(table), tmp_path / f"a.{kind}")
    job = Setting({"scenes": 130, "cameras": {"more": [{"name": "a", "poses": f"a.{kind}"}]}}).job
    file = open_poses(job, tmp_path)["a"]
    for scene_id in (0, 63, 64, 129):
        heights = [T[2, 3] for T, _ in poses_of(file, scene_id)[1]]
        assert heights == (np.arange(scene_id, count, 130) / 1e3).tolist()
    kept = len(read_poses(file, 64).T)
    assert kept == sum(64 <= n % 130 < 128 for n in range(count))


NO_VIEW: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "below": (
        {"ring": {"count": 2, "inclination_rad": -0.9, "radius_m": 2.0}},
        {},
        "camera a, number 0, .* is below the floor",
    ),
    "object": ({"ring": {"count": 2, "radius_m": 0.01}}, {}, "camera a, number 0, .* is inside of can"),
    "table": (
        {"ring": {"count": 1, "inclination_rad": -0.5, "radius_m": 0.02}, "about": "table"},
        {},
        "camera a, number 0, .* is inside of the table",
    ),
    "preset": ({"preset": "trellis"}, {}, r"camera a, number \d+, .* the table.*: set scene: studio"),
    "beside": (
        {"beside": "input", "offset_m": [0.0, 0.0, 0.74]},
        {"orbit": {"radius_m": 0.8}},
        "camera a at .* has the table nearer than 0.05 m before it, .*: change its offset_m",
    ),
    "off": (
        {"ring": {"count": 1}, "sensor": {"width": 64, "height": 48, "cx": -5.0}},
        {},
        r"the principal point \(-5, 240\) is not within the 64 x 48 pixels",
    ),
    "far": (
        {"ring": {"count": 1, "radius_m": "1%"}, "fov_deg": 1},
        {},
        "does not see them within images.depth_range_m",
    ),
}


@pytest.mark.parametrize("name", NO_VIEW)
def test_a_camera_that_cannot_stand_there_makes_a_failure_that_names_it(name):
    entry, others, told = NO_VIEW[name]
    with pytest.raises(ViewError, match=told):
        make(Setting({"cameras": {**others, "more": [{"name": "a", **entry}]}}))


def test_a_mirror_camera_within_its_object_makes_a_failure_with_the_remedy():
    for T_z_m, told in (
        (0.01, "camera mirror at .* is inside of can.*: take a larger cameras.mirror.T_z_m, or fit"),
        ("fit", ""),
    ):
        with pytest.raises(ViewError, match=told) if told else contextlib.nullcontext():
            cameras = {"mirror": {"enabled": True, "T_z_m": T_z_m}, "orbit": {"inclination_rad": [0.1, 0.2]}}
            make(Setting({"scene": "studio", "cameras": cameras}))


def test_a_camera_before_which_the_near_plane_cuts_something_has_no_room_and_one_that_looks_past_it_has():
    """A cube of 0.2 m about (0, 0, 1): 0.049 m before its face it is cut, 0.051 m before it is not, nor where it looks aside."""
    plan = make(alone(box(0.2, 0.2, 0.2))).scene.plan
    things = things_of(plan, [translation(0.0, 0.0, 1.0)])
    k = Intrinsics(**SMALL_SENSOR)
    for place_m, aim, told in (
        (0.149, (0.0, 0.0, 1.0), "has .* nearer than 0.05 m before it, where nothing is seen: move"),
        (0.151, (0.0, 0.0, 1.0), ""),
        (0.149, (0.149, 1.0, 1.0), ""),
        (0.05, (0.0, 0.0, 1.0), "is inside of"),
    ):
        camera = Camera(k, look_at(np.array([place_m, 0.0, 1.0]), np.array(aim)))
        with pytest.raises(ViewError, match=told) if told else contextlib.nullcontext():
            require_room("a", camera, plan, things, IN_TABLE)


def test_a_preset_that_stands_nearer_to_a_metric_object_than_depth_begins_is_a_failure_with_both_remedies():
    """Sixteen views at 30 degrees of a cube: at yaw 45 its corner is (root 1.5 + 0.5) / 2 of its side before the middle."""
    side_m, more = 0.3, [{"name": "a", "preset": "syncdreamer"}]
    nearest_m = side_m * (1.5 - (math.sqrt(1.5) + 0.5) / 2.0)
    for low_m in (nearest_m - 1e-6, nearest_m + 1e-6):
        keys = {"cameras": {"more": more, "sensor": SMALL_SENSOR}, "images": {"depth_range_m": [low_m, 5.0]}}
        setting = alone(box(side_m, side_m, side_m), **keys)
        if low_m < nearest_m:
            make(setting)
            continue
        with pytest.raises(ViewError, match=r"camera a, number \d+, has .* images.depth_range_m, or set studio.scale"):
            make(setting)


def test_views_that_miss_the_object_say_so_and_fit_keeps_small_and_flat_things_in_range(tmp_path):
    """A camera that looks away, one whose principal point is far outside; fit as near as depth begins."""
    away = look_at(np.array([0.0, 0.9, 1.6]), np.array([0.0, 1.8, 2.0])).ravel().tolist()
    more = [
        {"name": "away", "poses": poses_file(tmp_path, "away.json", [{"T_world_cam": away}])},
        {"name": "off", "ring": {"count": 1, "radius_m": 1.0}, "sensor": {"width": 64, "height": 48, "cx": 5000.0}},
    ]
    store, _ = make_dataset(tmp_path / "out", scenes=1, cameras={"more": more}, check={"raycast_share": 1.0})
    rows = find_scene(store, 0).rows
    for name in ("away", "off"):
        (view,) = (each for each in rows["views"] if each["role"] == name)
        (label,) = (each for each in rows["objects"] if each["role"] == name and each["region_id"] == 3)
        assert (view["object_pixels"], label["u"], label["v"], label["pixels"]) == (0, -1, -1, 0)
    assert faults_of(store) == verify_independently(store, 1, lambda _: None).faults == []
    for mesh in (box(0.004, 0.004, 0.004), box(0.2, 0.2, 1e-7)):
        around = {"more": [{"name": "a", "ring": {"count": 4}}], "orbit": {"radius_m": "fit"}}
        made = make(alone(mesh, cameras=around, images={"depth_range_m": [0.2, 13.0]}, check={"raycast_share": 1.0}))
        for view in (view for _, view in made.scene.views() if view.role == "a"):
            assert (view.region > 0).any() and (view.depth[view.region > 0] > 0).all()


@pytest.mark.minute
def test_a_thousand_views_of_a_scene_take_no_more_memory_than_a_hundred():
    code = """
import resource, sys
from tests.workers.scene.test_cameras import views_of_a_ring
views_of_a_ring(10), views_of_a_ring(100)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
views_of_a_ring(1000)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout.split()[-1]) < 1000 * 128 * 128 * 7 / 2**20 / 2  # half of what the images of all take


def views_of_a_ring(count: int) -> None:
    """Draws each view of a ring, and keeps none."""
    sensor = {"width": 128, "height": 128, "fx": 128.0, "fy": 128.0, "cx": 64.0, "cy": 64.0}
    setting = Setting(
        {"scene": "studio", "cameras": {"sensor": sensor, "more": [{"name": "a", "ring": {"count": count}}]}}
    )
    scene = make_scene(context_of(setting.job), 0, Stopwatch())
    assert sum(1 for _ in scene.views()) == count + 1

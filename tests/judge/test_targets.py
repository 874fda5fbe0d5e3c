"""Image targets of small scenes by their definitions, and that each wrong formula is found."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from schemas.base import Range
from schemas.job.views import Targets
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from services.job.job_file import validate_job
from services.read.audit import verify_independently
from services.read.independent.derive import StoredPair, check_images
from services.read.independent.poses import check_pair
from services.read.independent.targets import check_targets
from tests.captures import captures_job, exact_capture, use_exact_captures
from tests.datasets import SMALL, make_dataset, overlaid
from tests.judge.targets import context_of, judge_scene, pairs_of, stored_pairs
from tests.kit.tiers import first_of
from workers.capture import make_capture
from workers.geometry.frames import translation
from workers.geometry.mesh import corner_weights
from workers.scene import pairs, rows
from workers.scene.context import WorkerContext
from workers.scene.make_scene import Laid, lay_scene, render_scene
from workers.stopwatch import Stopwatch
from workers.targets import painting, surfaces, targets

EVERY = {"views": ["normals", "coordinates", "albedo", "covisible", "amodal", "layers"]}
NEAR = {
    "objects_per_scene": 3,
    "start": {"pose": "placed", "offset_m": [-0.1, 0.1]},
    "images": {"depth_range_m": [1.2, 2.5]},
    "targets": EVERY,
}
"""Three objects, parts of them out of the range of stored depth."""


def job_of(changes: dict) -> str:
    return validate_job(overlaid(SMALL, changes), "test").model_dump_json()


@pytest.fixture(scope="module")
def three() -> tuple[WorkerContext, Laid]:
    """Three objects at rest, before anything is drawn, for the input camera alone."""
    off = {"enabled": False}
    alone: dict = {"cameras": {"depth": off, "mirror": off}, "images": {"projection": off}}
    alone["targets"] = {"views": [name for name in EVERY["views"] if name != "covisible"]}
    context = context_of(job_of(overlaid(NEAR, alone)))
    return context, lay_scene(context, 0, Stopwatch())


@pytest.mark.parametrize(
    "changes", first_of([NEAR, {"targets": EVERY | {"smooth": True, "layers": 2}}], 1), ids=["three", "smooth"]
)
def test_every_pixel_of_every_target_is_what_the_stored_shapes_show(changes):
    for scene_id in range(2):
        findings, faults = judge_scene(job_of(changes), scene_id)
        assert faults == [] and not any(finding.wrong for finding in findings)
        assert all(finding.pixels > 0 for finding in findings) and len(findings) >= 15


def shifted(camera: Camera) -> Camera:
    k = camera.intrinsics
    return Camera(k.model_copy(update={"cx": k.cx + 0.5}), camera.T_world_cam)


def seen(name: str, change: Callable) -> Callable:
    """Changes the image that a target of what is seen has."""

    def plant(monkeypatch):
        original = targets._OF_SEEN[name]
        monkeypatch.setitem(targets._OF_SEEN, name, lambda *given: change(original(*given), *given))

    return plant


def called(name: str, change: Callable, module=targets) -> Callable:
    """Changes what a function of the producer is given or returns: `change(original)` takes its place."""
    return lambda monkeypatch: monkeypatch.setattr(module, name, change(getattr(module, name)))


def without_last_surface(original: Callable) -> Callable:
    """Of pixels with more than two surfaces, the last one is left out."""

    def planted(triangles):
        found = original(triangles)
        count = np.diff(found.start)
        last = found.start[1:][count > 2] - 1
        start = np.concatenate([[0], np.cumsum(count - (count > 2))])
        return surfaces.Surfaces(start, np.delete(found.z, last), np.delete(found.face, last))

    return planted


def only_visible(original: Callable) -> Callable:
    """A silhouette without what is hidden."""

    def planted(triangles, found, regions):
        masks = original(triangles, found, regions)
        some = np.flatnonzero(np.diff(found.start))
        nearest = np.zeros(masks[0].size, int)
        nearest[some] = triangles.region[found.face[found.start[some]]]
        for mask, region in zip(masks, regions, strict=True):
            mask[nearest.reshape(mask.shape) != region] = 0
        return masks

    return planted


def along_the_ray(original: Callable) -> Callable:
    """z becomes the ray's length."""

    def planted(triangles):
        found, (width, _), (fx, fy, cx, cy) = original(triangles), triangles.size, triangles.k
        row, column = np.divmod(np.repeat(np.arange(len(found.start) - 1), np.diff(found.start)), width)
        length = np.sqrt(1.0 + ((column + 0.5 - cx) / fx) ** 2 + ((row + 0.5 - cy) / fy) ** 2)
        return dataclasses.replace(found, z=found.z * length)

    return planted


def turned_over(image, *_):
    """The x of normals in the other direction."""
    return np.where(image.any(axis=2, keepdims=True), image ^ np.array([0xFFFF, 0, 0], np.uint16), image)


def of_the_world(original: Callable) -> Callable:
    """Normals of faces in the world's frame."""

    def planted(things, camera):
        found = original(things, camera)
        return dataclasses.replace(found, planes=(found.planes[0] @ camera.T_world_cam[:3, :3].T, found.planes[1]))

    return planted


def mixed_in_srgb(monkeypatch) -> None:
    """Texels are mixed as codes."""
    monkeypatch.setattr(targets, "LINEAR", np.arange(256, dtype=np.uint16) * np.uint16(257))
    monkeypatch.setattr(targets, "_kept_texels", targets._texels_of)
    monkeypatch.setattr(painting, "CODES", np.rint(np.arange(65_536) / 65_535 * 255).astype(np.uint8))


def a_millimetre_off(original: Callable) -> Callable:
    """Objects are a millimetre aside."""
    aside = np.array([[0.0, 0.0, 0.0, 1e-3], *[[0.0] * 4] * 3])
    return lambda found, regions, region_id, T, *more: original(found, regions, region_id, T + aside, *more)


def in_half_precision(image, *_):
    return np.rint((image / 65_535).astype(np.float16).astype(float) * 65_535).astype(np.uint16)


WRONG: dict[str, tuple[Callable, str]] = {
    "a normal's x": (seen("normals", turned_over), "normals: "),
    "normals of the world": (called("triangles_of", of_the_world), "normals: "),
    "shading normals": (
        seen("normals", lambda _, own, *more: targets.draw_normals(own, Targets(smooth=True))),
        "normals: ",
    ),
    "half a pixel": (called("triangles_of", lambda f: lambda things, camera: f(things, shifted(camera))), "layers: "),
    "a millimetre": (called("paint_points", a_millimetre_off), "coordinates: "),
    "half precision": (seen("coordinates", in_half_precision), "coordinates: "),
    "the longest side as 1": (
        called(
            "coordinate_scale", lambda f: lambda shape: (np.ptp(shape.bounds, axis=0).max().item(), f(shape)[1]), rows
        ),
        "coordinates' scale and offset are",
    ),
    "a middle off by 1 %": (
        seen("coordinates", lambda image, *_: np.where(image > 655, image - 655, 0)),
        "coordinates: ",
    ),
    "red and blue": (seen("albedo", lambda image, *_: image[..., ::-1]), "albedo: "),
    "texels mixed in sRGB": (mixed_in_srgb, "albedo: "),
    "nothing hidden": (called("whole_silhouettes", only_visible), "amodal: "),
    "a pixel too many": (
        called(
            "amodal_columns", lambda f: lambda mask: f(mask) | {"amodal_pixels": f(mask)["amodal_pixels"] + 1}, rows
        ),
        "amodal_pixels is",
    ),
    "no last surface": (called("all_surfaces", without_last_surface), "layers: "),
    "length of the ray": (called("all_surfaces", along_the_ray), "layers: "),
    "depth in half precision": (
        called("quantise_depth", lambda f: lambda z, images: f(z.astype(np.float16).astype(float), images)),
        "layers: ",
    ),
    "depth out of range": (
        called(
            "quantise_depth",
            lambda f: lambda z, images: f(z, images.model_copy(update={"depth_range_m": Range(0.2, 8.0)})),
        ),
        "layers: ",
    ),
    "the first for the last": (
        called("peel_layers", lambda f: lambda *given: (drawn := f(*given)) | {"back": drawn["layer1"]}),
        "layers: ",
    ),
}
"""(what is planted, what is told)."""


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_target_is_found(monkeypatch, three, name):
    plant, told = WRONG[name]
    plant(monkeypatch)
    context, laid = three
    scene = render_scene(context, laid, Stopwatch())
    faults = [fault for pair in stored_pairs(context, scene) for fault in check_pair(pair)]
    assert any(told in fault for fault in faults), faults


UNSEEN: tuple[Callable, ...] = (
    lambda f: lambda things, camera: f(things[-1:], camera),
    lambda f: lambda things, camera: f(things, Camera(camera.intrinsics, camera.T_world_cam @ translation(0.1, 0, 0))),
)


@pytest.mark.minute
def test_a_covisible_mask_by_one_thing_alone_or_of_a_camera_aside_is_found_and_so_is_a_wrong_pixel(monkeypatch):
    context = context_of(job_of(overlaid(NEAR, {"targets": {"views": ["covisible"]}})))
    laid = lay_scene(context, 1, Stopwatch())
    (pair,) = stored_pairs(context, render_scene(context, laid, Stopwatch()))
    assert check_pair(pair) == []
    assert ("input", "covisible") not in pair.images
    image, region = (pair.images["mirror", kind] for kind in ("covisible", "region"))
    for place, value in (((region >= 3) & (image == 255), 0), ((region >= 3) & (image == 0), 255), (region == 2, 255)):
        where, faults = np.argwhere(place), list[str]()
        for row, column in where[:: len(where) // 6]:
            wrong = image.copy()
            wrong[row, column] = value
            changed = dataclasses.replace(pair, images=pair.images | {("mirror", "covisible"): wrong})
            told = list(check_targets(changed, pair.views["mirror"]))
            assert all(": 1 of " in fault and f"({column}, {row})" in fault for fault in told)
            faults += told
        assert len(faults) >= 4
    for change in UNSEEN:
        with monkeypatch.context() as patch:
            patch.setattr(pairs, "Sight", change(targets.Sight))
            (pair,) = stored_pairs(context, render_scene(context, laid, Stopwatch()))
        assert any("covisible: " in fault for fault in check_pair(pair))


def test_a_point_beyond_a_long_narrow_face_has_the_weights_of_the_nearest_point_of_its_edges():
    """Against points all along the edges. Weights cut one after the other are 40 mm off here."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.9, 0.002, 0.0]])
    points = np.array(
        [[0.5, 0.0012, 0.0], [0.5, -0.0001, 3e-5], [0.95, 0.0013, 0.0], [-0.1, 0.0, 0.0], [0.6, 0.001, 0.0]]
    )
    face = Mesh(corners, np.array([[0, 1, 2]], np.int32))
    _, weights = corner_weights(points, face, np.zeros(len(points), np.int64))
    share = np.linspace(0.0, 1.0, 100_001)[:, None]
    edges = np.concatenate([(1.0 - share) * corners[n] + share * corners[(n + 1) % 3] for n in range(3)])
    for point, found in zip(points[:4], weights @ corners, strict=False):
        assert np.linalg.norm(found - edges[np.linalg.norm(edges - point, axis=1).argmin()]) < 1e-4
    assert np.allclose(weights[4] @ corners, points[4], atol=1e-15)


def test_a_stored_dataset_is_judged_and_what_is_not_is_told(tmp_path):
    store, _ = make_dataset(tmp_path, targets=EVERY, output={"layout": "tar"})
    found = verify_independently(store, 2, lambda _: None)
    assert found.faults == [] and "albedo of the floor is not derived: its look is in no file" in found.underived
    for path in (tmp_path / "assets").rglob("*.glb"):
        path.unlink()
    found = verify_independently(store, 2, lambda _: None)
    assert found.faults == []
    assert sum("in 2 scenes: " in line and ".glb is not stored" in line for line in found.underived) == 1


@pytest.fixture(scope="module")
def holed() -> StoredPair:
    """Of a capture whose merged mesh has half of its faces."""
    done = exact_capture()
    across = done.surface.vertices[done.surface.faces][..., 1].mean(axis=1)
    used, faces = np.unique(done.surface.faces[across < np.median(across)], return_inverse=True)
    vertices, colors = done.surface.vertices[used], done.surface.vertex_colors[used]
    half = dataclasses.replace(
        done.surface, vertices=vertices, faces=faces.reshape(-1, 3).astype(np.int32), vertex_colors=colors
    )
    context = context_of(captures_job(targets={"views": CAPTURED}).model_dump_json())
    with pytest.MonkeyPatch.context() as patch:
        use_exact_captures(patch)
        patch.setattr(make_capture, "process_capture", lambda *_: dataclasses.replace(done, surface=half))
        return next(pairs_of(context.job, make_capture.run_capture(context, 0, Stopwatch())))


CAPTURED = ["normals", "coordinates", "layers"]
BROKEN: dict[str, tuple[str, str, int, int | tuple[int, int, int]]] = {
    "a normal by 0.07 degrees": ("normals", "seen", 1, (40, 0, 0)),
    "a coordinate by two codes": ("coordinates", "seen", 1, (0, 2, 0)),
    "a normal of a hole": ("normals", "hole", 0, (0, 0, 32_767)),
    "a coordinate of a hole": ("coordinates", "hole", 0, 32_767),
    "a hole where there is none": ("coordinates", "seen", 0, 0),
    "no normal of the board": ("normals", "board", 0, 0),
    "a layer by two units": ("layer1", "seen", 1, 2),
    "no region of the last surface": ("back_region", "seen", 0, 0),
    "a surface too many": ("layer4", "board", 0, 4_000),
}
"""(kind, where its one wrong pixel is, what its value is multiplied with, what is added)."""


@pytest.mark.parametrize("role", ["input", "mirror"])
def test_a_wrong_pixel_of_a_capture_is_found_also_over_a_hole_and_a_wrong_share_of_it(holed, role):
    view = holed.views[role]
    assert [*check_images(holed, view), *check_targets(holed, view)] == []
    region, there = holed.images[role, "region"], holed.images[role, "coordinates"].any(axis=2)
    clear = ~holed.images[role, "layer1"].astype(bool)
    places = {"seen": (region == 3) & there, "hole": (region == 3) & clear, "board": (region == 2) & clear}
    for name, (kind, place, times, more) in BROKEN.items():
        where = np.argwhere(places[place])
        image, (row, column) = holed.images[role, kind].copy(), where[len(where) // 2]
        image[row, column] = times * image[row, column].astype(int) + more
        faults = check_targets(dataclasses.replace(holed, images=holed.images | {(role, kind): image}), view)
        assert any(": 1 of " in fault and f"({column}, {row})" in fault for fault in faults), name
    own = [{**row, "targets_share": 0.5} for row in holed.objects]
    faults = list(check_targets(dataclasses.replace(holed, objects=own), view))
    assert sum("targets_share is 0.5, its image gives 0." in fault for fault in faults) == 1
    assert sum("region 2: targets_share is 0.5, its image gives None" in fault for fault in faults) == 1

"""The second derivation: healthy datasets pass; a wrong formula of the producer passes plain verify, and not this one."""

import copy
import dataclasses
import json
import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import services.merge.tables as tables
import workers.assets.poses as poses
import workers.geometry.camera as camera
import workers.geometry.pixels as pixels
import workers.geometry.projection as projection
import workers.render.pathtraced as pathtraced
import workers.scene.cameras as cameras
import workers.scene.labels as labels
import workers.scene.pairs as pairs
from schemas.dataset.shard import Fingerprint
from schemas.job.cameras import Sensor
from schemas.scene.view import Camera, Intrinsics
from services.read.audit import describe_independent, verify_independently
from services.read.independent import rays
from services.read.independent.poses import check_forces
from tests.captures import CAMERA, captures_job, exact_capture, use_exact_captures
from tests.datasets import faults_of, make_dataset, overlaid, run_here
from tests.kit.tiers import first_of
from workers.capture import make_capture, rows
from workers.geometry.camera import look_at
from workers.geometry.frames import pose, rotation_about, translation
from workers.render.raster.gbuffer import shared_renderer
from workers.shard.fingerprint import take_fingerprint
from workers.targets.targets import draw_targets

NAMED: list[dict[str, Any]] = [
    {"name": "left", "beside": "input", "offset_m": [-0.06, 0.01, 0.02], "rotation_deg": [3.0, -8.0, 5.0]},
    {
        "name": "around",
        "ring": {"count": 3, "inclination_rad": [0.3, 0.6], "start_rad": 0.4, "start": "input", "radius_m": [0.8, 1.2]},
        "roll_deg": [-20, 30],
    },
    {
        "name": "hammersley",
        "sphere": {"count": 3, "inclination_rad": [0.4, 1.2]},
        "sensor": {"width": 90, "height": 120, "fx": 100, "fy": 140, "cx": 50, "cy": 66},
    },
    {"name": "spiral", "sphere": {"count": 3, "pattern": "fibonacci", "inclination_rad": [0.3, 1.5]}, "fov_deg": 40},
    {
        "name": "over",
        "sphere": {"count": 2, "pattern": "uniform", "inclination_rad": [0.3, 1.5], "radius_m": [1.0, 2.0]},
        "about": "table",
    },
]
"""An entry of each kind, with every key that says where a camera stands."""

ALONE: dict[str, Any] = {
    "scene": "studio",
    "studio": {"scale": "unit_cube"},
    "cameras": {
        "more": [
            {"name": "trellis", "sphere": {"count": 5, "pattern": "trellis"}},
            *({"name": name, "preset": name} for name in ("zero123", "syncdreamer", "zero123plus", "lrm")),
        ]
    },
}

DRAWN: dict[str, Any] = {
    "sensor": {
        "width": 160,
        "height": 120,
        "fx": [110.0, 150.0],
        "fy": [120.0, 140.0],
        "cx": [76.0, 84.0],
        "cy": [60.0, 60.0],
    },
    "orbit": {"radius_m": [1.2, 1.6], "roll_deg": [-30.0, 30.0], "aim_m": [-0.02, 0.02]},
    "mirror": {"T_z_m": [1.2, 1.5]},
    "more": NAMED[:2],
}
"""A range for every number of the cameras that may have one."""

HEALTHY = {
    "ranges": {"cameras": DRAWN, "pairs_per_scene": 2},
    "named": {"cameras": {"more": NAMED}, "pairs_per_scene": 2, "objects_per_scene": 2},
    "studio": {**ALONE, "scenes": 1, "targets": {"views": ["normals"]}},
    "studio, other side": {
        "scene": "studio",
        "cameras": {"mirror": {"enabled": True}, "orbit": {"aim_m": [-0.05, 0.05], "radius_m": [1.2, 2.0]}},
        "images": {"projection": {"enabled": True}},
    },
    "distances": {"cameras": {"orbit": {"radius_m": [2.0, 2.8]}}},
    "defaults": {},
    "several": {
        "objects_per_scene": 3,
        "pairs_per_scene": 2,
        "cameras": {"mirror": {"T_z_m": 1.1, "percentile": 0.0}},
    },
    "frictions": {"physics": {"friction": {"mug": 0.3, "table": 1.2}}, "objects_per_scene": 2},
    "median, tar": {"cameras": {"mirror": {"percentile": 50.0}}, "output": {"layout": "tar"}},
    "no mirror": {
        "cameras": {"mirror": {"enabled": False, "T_z_m": [1.0, 1.6]}},
        "images": {"projection": {"enabled": False}},
    },
    "no colour": {"cameras": {"depth": {"enabled": False}}, "render": {"rgb": False}},
    "noise": {"sensor": {"depth_noise": {}, "distortion": {"k1": -0.1}, "rgb_noise": {}, "exposure": {}}},
    "framed": {"cameras": {"orbit": {"radius_m": "4%"}, "mirror": {"T_z_m": "fit"}}},
    "splat": {"images": {"projection": {"splat": 3}}},
}


@pytest.mark.parametrize("name", first_of(HEALTHY, 4))
def test_a_healthy_dataset_has_no_faults(tmp_path, name):
    store, _ = make_dataset(tmp_path, **HEALTHY[name])
    found = verify_independently(store, 9, lambda _: None)
    assert found.faults == []
    scenes = HEALTHY[name].get("scenes", 2)
    assert (found.scenes, found.pairs) == (scenes, scenes * HEALTHY[name].get("pairs_per_scene", 1))
    assert "nothing off" in "\n".join(describe_independent(found))


@pytest.fixture(scope="module")
def fingerprint() -> Fingerprint:
    """Taken before anything is planted: its canary scene has stricter checks."""
    return take_fingerprint(shared_renderer(), "raster")


@pytest.fixture
def plant(monkeypatch, fingerprint) -> Callable[[Callable, Callable], None]:
    """Puts a function in another's place in every module that has it by name."""
    monkeypatch.setattr("tests.datasets.take_fingerprint", lambda *_: fingerprint)

    def replace(original: Callable, planted: Callable) -> None:
        for module in list(sys.modules.values()):
            if getattr(module, original.__name__, None) is original:
                monkeypatch.setattr(module, original.__name__, planted)

    return replace


def turned_mirror(sign: float) -> Callable:
    """The article's product, Rot_x(phi) Rot_y(pi) Rot_x(-phi), which holds without roll alone, or with phi's other sign."""

    def planted(T_world_cam, d_z_m, T_z_m=1.3, up=None):
        tilt = rotation_about(np.array([1.0, 0.0, 0.0]), sign * camera.inclination(T_world_cam))
        turn = pose(tilt @ np.diag([-1.0, 1.0, -1.0]) @ tilt.T, np.zeros(3))
        return T_world_cam @ translation(0, 0, d_z_m) @ turn @ translation(0, 0, -T_z_m)

    return planted


def farther_mirror(original: Callable) -> Callable:
    return lambda T, d_z_m, T_z_m=1.3, *up: original(T, d_z_m, T_z_m + 1e-3, *up)


def shifted(seen: Camera, du: float, dv: float = 0.0) -> Camera:
    k = seen.intrinsics
    return Camera(k.model_copy(update={"cx": k.cx + du, "cy": k.cy + dv}), seen.T_world_cam)


def other_offset(original: Callable) -> Callable:
    def planted(seen, job):
        turned = {"offset_m": tuple(-x for x in job.cameras.depth.offset_m)}
        cameras = job.cameras.model_copy(update={"depth": job.cameras.depth.model_copy(update=turned)})
        return original(seen, job.model_copy(update={"cameras": cameras}))

    return planted


def ties_to_the_highest_index(original: Callable) -> Callable:
    """The input image and its camera turned by half a turn: the same cloud, its pixels in the opposite order."""

    def planted(depth, source, target, *rest):
        k = source.intrinsics
        turned = k.model_copy(update={"cx": k.width - k.cx, "cy": k.height - k.cy})
        opposite = Camera(turned, source.T_world_cam @ np.diag([-1.0, -1.0, 1.0, 1.0]))
        found = original(np.ascontiguousarray(depth[::-1, ::-1]), opposite, target, *rest)
        index = np.where(found.source >= 0, depth.size - 1 - found.source, -1).astype(np.int32)
        return projection.Projected(found.depth_m, index)

    return planted


def box_without_its_last_column(original: Callable) -> Callable:
    def narrow(extent):
        x, y, width, height = extent.bbox_xywh
        return extent._replace(bbox_xywh=(x, y, width - 1, height)) if extent.pixels else extent

    return lambda region: [narrow(extent) for extent in original(region)]


def rounded_image_coordinates(original: Callable) -> Callable:
    def planted(T_cam_obj, k):
        u, v = original(T_cam_obj, k)
        return (u, v) if u < 0 else (round(k.fx * T_cam_obj[0, 3] / T_cam_obj[2, 3] + k.cx), v)

    return planted


def patch_too_far_left(original: Callable) -> Callable:
    def planted(*arguments):
        box = original(*arguments)
        return box and (box[0], slice(box[1].start - 1, box[1].stop - 1))

    return planted


def transposed(original: Callable) -> Callable:
    """The matrix of each line of a merged file column by column."""

    def planted(rows):
        words = [line.split(",") for line in original(rows).decode().splitlines()]
        lines = [[*line[:2], *np.array(line[2:]).reshape(4, 4).T.ravel()] for line in words]
        return "".join(",".join(map(str, line)) + "\n" for line in lines).encode()

    return planted


WRONG = {
    "mirrored phi": (cameras.mirror_pose, lambda _: turned_mirror(-1.0), "T_world_cam of mirror is off"),
    "nearest for percentile": (
        pairs.front_distance,
        lambda f: lambda z, own, mirror: f(z, own, mirror.model_copy(update={"percentile": 0.0})),
        "the object's input depth gives",
    ),
    "offset": (cameras.place_beside, other_offset, "T_world_cam of aligned is off by 0.1"),
    "orbit": (
        camera.orbit_pose,
        lambda f: lambda centre, inclination, yaw, radius: f(centre, inclination, yaw, 0.99 * radius),
        "does not look at the table's centre",
    ),
    "yaw": (camera.yaw, lambda f: lambda T: -f(T), "is not the direction from the table to the camera"),
    "half a pixel in rendering": (
        pathtraced.draw_view,
        lambda f: lambda renderer, things, look, seen, *rest: f(renderer, things, look, shifted(seen, 0, 0.5), *rest),
        "mm off the floor's plane",
    ),
    "half a pixel in projection": (
        projection.forward_project,
        lambda f: lambda depth, source, *rest: f(depth, shifted(source, 0.5), *rest),
        "depth pixels are not those of the input cloud",
    ),
    "ties": (projection.forward_project, ties_to_the_highest_index, "ties do not go to the lowest source index"),
    "box": (pixels.measure_regions, box_without_its_last_column, "bbox_xywh is"),
    "coordinates": (camera.image_coordinates, rounded_image_coordinates, "is not the pixel of the object's origin"),
    "patch": (labels.crop_box, patch_too_far_left, "is not the crop about"),
    "transposed poses": (tables.cam_pose_lines, transposed, "camPoses.csv: T01, T02, T03, "),
}
"""(the right formula, the wrong one made of it, what is told); one for each thing that is derived."""
MORE = {"yaw", "half a pixel in projection", "offset", "orbit", "coordinates", "cx_opencv"}
"""Those whose kind (a camera, an image, a label) another one stands for by default."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.minute] * (name in MORE)) for name in [*WRONG, "cx_opencv"]]
)
def test_a_wrong_formula_passes_plain_verify_and_not_the_second_derivation(tmp_path, monkeypatch, plant, name):
    if name == "cx_opencv":
        monkeypatch.setattr(Intrinsics, name, property(lambda k: k.cx + 0.5))
        told = "cx_opencv is 80.5, the job gives 79.5"
    else:
        original, wrong, told = WRONG[name]
        plant(original, wrong(original))
    store, _ = make_dataset(tmp_path, scenes=3)
    assert faults_of(store) == []
    faults = verify_independently(store, 3, lambda _: None).faults
    assert any(told in fault for fault in faults), faults


@pytest.mark.parametrize(
    ("share", "told"),
    [
        (lambda drawn: (drawn[0], 1.5, drawn[2]), "cx is 88.0, the job gives 76.0 to 84.0"),
        (lambda drawn: None, "fx and fy are "),
    ],
)
def test_numbers_of_a_camera_outside_their_ranges_or_not_as_far_along_are_found(tmp_path, monkeypatch, share, told):
    fixed = Sensor.fixed

    def planted(sensor: Sensor, drawn: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> Sensor:
        if changed := share(drawn):
            return fixed(sensor, changed)
        return fixed(sensor, drawn).model_copy(update={"fy": fixed(sensor, drawn[::-1]).fy})

    monkeypatch.setattr(Sensor, "fixed", planted)
    store, _ = make_dataset(tmp_path, scenes=1, cameras={"sensor": DRAWN["sensor"]})
    assert faults_of(store) == []
    faults = verify_independently(store, 1, lambda _: None).faults
    assert any(told in fault for fault in faults), faults


def only_named(f: Callable, **changes: Callable) -> Callable:
    """`render_view` whose images are those of a changed camera in views of named cameras."""

    def planted(scene, role, pair, camera, *rest):
        view = f(scene, role, pair, camera, *rest)
        if not rest[1:]:
            return view
        drawn = f(scene, role, pair, shifted(camera, 0.5), *rest)
        return dataclasses.replace(view, **{name: change(drawn, view) for name, change in changes.items()})

    return planted


def no_alpha_inside(rgb, region, alpha):
    return np.dstack([rgb, np.where(alpha == 255, 0, alpha)])


def tables_of_poses(folder: Path) -> list[dict[str, Any]]:
    """A camera of each form of table: rounded to five digits, of an object, with pinholes, scenes between one another."""
    stands = [
        look_at(np.array([x, 0.7, z]), np.zeros(3)) for x, z in ((0.4, 0.5), (-0.3, 0.9), (0.1, 1.0), (-0.6, 0.4))
    ]
    rows = [
        {"scene_id": n % 2, "T_obj_cam": np.round(T, 5).ravel().tolist(), "more": "x"} for n, T in enumerate(stands)
    ]
    pinhole = {"width": 90, "height": 70, "fx": 80.5, "fy": 81, "cx": 45, "cy": 33.5}
    pq.write_table(pa.Table.from_pylist(rows), folder / "object.parquet")
    world = look_at(np.array([0.1, 0.8, 1.7]), np.array([0.0, 0.0, 0.8]))
    (folder / "world.json").write_text(json.dumps([{"T_world_cam": world.tolist(), **pinhole}]))
    elements = [f"T{i}{j}" for i in range(4) for j in range(4)]
    (folder / "list.csv").write_text("\n".join(",".join(map(str, line)) for line in (elements, world.ravel())))
    return [
        {"name": name.partition(".")[0], "poses": str(folder / name)}
        for name in ("object.parquet", "world.json", "list.csv")
    ]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda stands: stands, ""),
        (lambda stands: stands[::-1], "T_world_cam of object_000 is off by"),
        pytest.param(
            lambda stands: [(T @ translation(0.0, 0.0, 1e-6), k) for T, k in stands],
            "T_world_cam of list_000 is off by ",
            marks=pytest.mark.minute,
        ),
        pytest.param(
            lambda stands: [(T, None) for T, _ in stands],
            "(world_000): width is 160, the job gives 90",
            marks=pytest.mark.minute,
        ),
        pytest.param(
            lambda stands: stands[:1], "has 1 views of camera object, and must have 2", marks=pytest.mark.minute
        ),
    ],
)
def test_poses_of_a_table_are_derived_from_the_file_at_hand(tmp_path, monkeypatch, wrong, message):
    more, of_scene = tables_of_poses(tmp_path), poses.Poses.of_scene
    monkeypatch.setattr(poses.Poses, "of_scene", lambda self, scene_id: iter(wrong(list(of_scene(self, scene_id)))))
    store, _ = make_dataset(tmp_path / "out", cameras={"more": more})
    found = verify_independently(store, 2, lambda _: None)
    assert any(message in fault for fault in found.faults) if message else found.faults == []
    assert not any("poses of" in line for line in found.underived)
    (tmp_path / "list.csv").write_text((tmp_path / "list.csv").read_text() + " ")
    lines = verify_independently(store, 2, lambda _: None).underived
    assert any("list.csv is not here, or not what it was" in line for line in lines)


WRONG_NAMED: dict[str, tuple[object, str, Callable[[Any], object], dict[str, Any], str]] = {
    "beside": (
        cameras,
        "rotation_about",
        lambda f: lambda axis, angle: f(axis, -angle),
        {},
        "T_world_cam of left_000 is off",
    ),
    "step": (cameras, "_towards", lambda f: lambda around, z: f(1.02 * around, z), {}, "pattern ring: its direction"),
    "start": (cameras, "yaw", lambda f: lambda T: -f(T), {}, "camera around does not begin at start_rad"),
    "golden": (cameras, "GOLDEN", lambda value: 1.001 * value, {}, "pattern fibonacci: its direction"),
    "digits": (cameras, "_radical_inverse", lambda f: lambda n: n / 3.0, {}, "pattern hammersley: its direction"),
    "height": (
        cameras,
        "_towards",
        lambda f: lambda around, z: f(around, z**3),
        ALONE,
        "pattern trellis: its height is off",
    ),
    "band": (
        cameras,
        "_at_random",
        lambda f: lambda rng, *rest: f(rng, 0.0, 0.1, rest[-1]),
        {},
        "outside inclination_rad",
    ),
    "aim": (
        cameras,
        "look_at",
        lambda f: lambda position, target: f(position, target + 1e-4),
        {},
        "camera over does not look at table",
    ),
    "about": (
        cameras._Placed,
        "point",
        lambda f: lambda placed, about: f(placed, "object" if about == "table" else about),
        {},
        "camera over does not look at table",
    ),
    "range": (
        cameras,
        "_draw_distance",
        lambda f: lambda *given: 1.3 * f(*given),
        {},
        "camera around stands",
    ),
    "fit": (
        cameras._Placed,
        "fit_m",
        lambda f: lambda placed, share, k, ends: f(placed, share, k.model_copy(update={"fx": k.fy}), ends),
        {},
        "camera hammersley stands",
    ),
    "roll": (
        cameras,
        "_draw",
        lambda f: lambda rng, ends: f(rng, ends) - 40.0 * (ends.high == 30.0),
        {},
        "outside roll_deg",
    ),
    "lens": (
        cameras,
        "intrinsics_of",
        lambda f: lambda entry, sensor: f(entry.model_copy(update={"sensor": None}), sensor),
        {},
        "(hammersley_000): width is 160, the job gives 90",
    ),
    "unit": (
        cameras,
        "VIEW_PRESETS",
        lambda presets: {name: preset._replace(of="side", unit_m=1.0) for name, preset in presets.items()},
        ALONE,
        "camera zero123plus stands",
    ),
    "number": (
        pairs,
        "place_fixed",
        lambda f: lambda *given: (dataclasses.replace(each, number=1) for each in f(*given)),
        {},
        "has 1 views of camera left, and must have 1, numbered from 0",
    ),
    "drawn": (
        pairs,
        "render_view",
        lambda f: only_named(f, region=lambda drawn, view: drawn.region, depth=lambda drawn, view: drawn.depth),
        {},
        "depth and region:",
    ),
    "target": (
        pairs,
        "render_view",
        lambda f: only_named(f, further=lambda drawn, view: drawn.further),
        {"targets": {"views": ["normals"]}},
        "normals:",
    ),
    "alpha": (pairs, "with_alpha", lambda _: no_alpha_inside, ALONE, "alpha is 0 where the mask shows something"),
    "names": (tables, "view_name", lambda f: lambda role, number: f(role, number and 2 - number), {}, "cameras.csv:"),
}
"""(where it is, its name, the wrong one made of it, the job, what is told) for each thing that is derived of named cameras."""


@pytest.mark.parametrize("name", first_of(WRONG_NAMED, 2))
def test_a_named_camera_that_stands_or_shows_another_thing_is_found(tmp_path, monkeypatch, plant, name):
    owner, attribute, wrong, job, told = WRONG_NAMED[name]
    monkeypatch.setattr(owner, attribute, wrong(getattr(owner, attribute)))
    job = overlaid({"scenes": 1} | ({} if job is ALONE else {"cameras": {"more": NAMED}}), job)
    store, _ = make_dataset(tmp_path, **job)
    faults = verify_independently(store, 1, lambda _: None).faults
    assert any(told in fault for fault in faults), faults


def test_a_framed_object_that_covers_more_than_was_asked_for_is_found(tmp_path, plant):
    plant(cameras._frame, lambda *given, right=cameras._frame: right(*given[:-1], 1.2 * given[-1]))
    store, _ = make_dataset(tmp_path, scenes=1, **HEALTHY["framed"])
    assert faults_of(store) == []
    (fault,) = verify_independently(store, 1, lambda _: None).faults
    assert "cameras.orbit.radius_m" in fault


@pytest.mark.parametrize("wrong", [lambda _: turned_mirror(1.0), farther_mirror], ids=["without roll", "T_z"])
def test_a_wrong_mirror_camera_of_a_rolled_photograph_is_found(plant, tmp_path, monkeypatch, wrong):
    use_exact_captures(monkeypatch)
    plant(cameras.mirror_pose, wrong(cameras.mirror_pose))
    store, _ = run_here(captures_job(scenes=1), tmp_path)
    assert faults_of(store) == []
    faults = verify_independently(store, 1, lambda _: None).faults
    assert faults and all("T_world_cam of" in fault for fault in faults)


def test_depth_of_photographs_along_the_ray_instead_of_the_axis_is_found(tmp_path, monkeypatch):
    """A pixel at the edge of this wide camera is 40 % farther along its ray than along the axis."""
    use_exact_captures(monkeypatch)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    length = np.sqrt(1 + ((columns - CAMERA.cx) / CAMERA.fx) ** 2 + ((rows - CAMERA.cy) / CAMERA.fy) ** 2)

    def process(folder, captures, watch):
        done = exact_capture()

        def images(number):
            seen = done.images(number)
            return type(seen)(seen.number, seen.camera, seen.rgb, seen.depth_m * length**2, seen.mask)

        return type(done)(**{**vars(done), "images": images})

    monkeypatch.setattr(make_capture, "process_capture", process)
    store, _ = run_here(captures_job(scenes=1), tmp_path)
    assert any("off the board's plane" in fault for fault in verify_independently(store, 1, lambda _: None).faults)


def test_one_wrong_pixel_of_a_target_of_stored_captures_is_found(tmp_path, monkeypatch):
    use_exact_captures(monkeypatch)
    job = captures_job(scenes=1, targets={"views": ["coordinates"]})

    def planted(things, camera, region, *rest):
        images = draw_targets(things, camera, region, *rest)
        own = np.argwhere(region == 3)
        row, column = own[len(own) // 2]
        images["coordinates"][row, column, 0] += 3
        return images

    monkeypatch.setattr(rows, "draw_targets", planted)
    store, _ = run_here(job, tmp_path)
    assert faults_of(store) == []
    faults = verify_independently(store, 1, lambda _: None).faults
    assert len(faults) == 4 and all("coordinates: 1 of" in fault for fault in faults)


JOB = {"physics": {"friction": 0.7, "exact_rest": True}, "captures": None}
LOW, HIGH = 2.0 * 9.81, 1.0 * 9.81
UP, DOWN = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]


def contact(region: int, point: list[float], force: list[float], normal: list[float] = UP) -> dict:
    return {"with_region": region, "point": point, "normal": normal, "force": force}


LOW_CONTACTS = [contact(2, [x, 0.0, 0.0], [0.0, 0.0, (LOW + HIGH) / 2]) for x in (-0.1, 0.1)]
LOW_CONTACTS += [contact(4, [x, 0.0, 0.2], [0.0, 0.0, -HIGH / 2], DOWN) for x in (-0.05, 0.05)]
HIGH_CONTACTS = [contact(3, [x, 0.0, 0.2], [0.0, 0.0, HIGH / 2]) for x in (-0.05, 0.05)]
BODIES = [
    {"region_id": 3, "category": "box", "mass_kg": 2.0, "com": [0.0, 0.0, 0.1], "contacts": LOW_CONTACTS},
    {"region_id": 4, "category": "mug", "mass_kg": 1.0, "com": [0.0, 0.0, 0.3], "contacts": HIGH_CONTACTS},
]
"""A body of 1 kg on one of 2 kg, each held at two points."""


def nothing_below(low, high):
    high["contacts"], low["contacts"] = [], [contact(2, [0.0, 0.0, 0.0], [0.0, 0.0, LOW])]


def a_pull(low, high):
    for body, sign in ((low, 1), (high, -1)):
        for k, share in ((-2, 1.5), (-1, -0.5)):
            body["contacts"][k]["force"] = [0.0, 0.0, -sign * share * HIGH]


def sideways(low, high):
    for k, sign in ((0, 1), (1, -1)):
        low["contacts"][k]["force"][0] = sign * 0.6 * LOW


def no_reaction(low, high):
    for k in (-2, -1):
        low["contacts"][k]["force"] = [0.0, 0.0, -1.0001 * HIGH / 2]


def test_forces_of_a_scene_in_balance_have_no_fault_and_each_wrong_one_is_told():
    def faults(edit: Callable, job: dict = JOB, effects: Sequence[str] = (), fallen: Collection[int] = ()) -> str:
        bodies = copy.deepcopy(BODIES)
        edit(*bodies)
        return "; ".join(check_forces(job, {"scene_id": 7, "bodies": bodies, "effects": effects}, fallen))

    assert faults(lambda low, high: None) == ""
    assert faults(nothing_below, effects=["kept_poses"]) == ""  # what is kept may hang in the air
    assert faults(nothing_below, effects=["kept_poses"], fallen={4}) == "scene 7, region 4: nothing holds it"
    assert "presses region 4" in faults(no_reaction, effects=["kept_poses"])
    for edit, told in (
        (nothing_below, "region 4: nothing holds it"),
        (lambda low, high: high.update(mass_kg=1.02), "region 4: its contact forces leave 2.0% of its weight over"),
        (lambda low, high: high.update(com=[0.002, 0.0, 0.3]), "region 4: its contact forces turn it, by"),
        (a_pull, "a contact pulls"),
        (sideways, "a contact needs more than its friction of 0.49"),
        (no_reaction, "scene 7: region 3 presses region 4 with another force"),
        (lambda low, high: low["contacts"][0].update(normal=[0.0, 0.0, 1.001]), "has not the length 1"),
    ):
        assert told in faults(edit)
    given = {"box": 2.0, "mug": 0.25}  # 0.5 between them

    def pushed(box: float | None, mug: float | None, share: float, job: Any = given) -> str:
        """The mug pushed both ways by this share of what presses it."""

        def edit(low, high):
            low["friction"], high["friction"] = box, mug
            for k, sign in ((0, share), (1, -share)):
                high["contacts"][k]["force"][0] = sign * HIGH / 2
                low["contacts"][k + 2]["force"][0] = -sign * HIGH / 2

        return faults(edit, {"physics": {"friction": job, "exact_rest": True}, "captures": None})

    assert pushed(2.0, 0.25, 0.499) == ""
    assert "region 4: a contact needs more than its friction of 0.5" in pushed(2.0, 0.25, 0.501)
    assert "region 4: a contact needs more than its friction of 0.48" in pushed(2.0, 0.24, 0.499)
    assert "region 4: its friction is 0.24, and physics.friction gives 0.25" in pushed(2.0, 0.24, 0.4)
    assert "region 3: its friction is None, and physics.friction gives 2" in pushed(None, 0.25, 0.4)
    assert "region 3: its friction is 2.0, and physics.friction gives 0.7" in pushed(2.0, None, 0.4, 0.7)
    without_rest = {"physics": {"friction": 0.7, "exact_rest": False}, "captures": None}
    assert faults(nothing_below, without_rest) == faults(nothing_below, {**JOB, "captures": {}}) == ""


@pytest.mark.parametrize(
    ("cosine", "right_mm", "wrong_mm"), [(0.005, 0.3, 1.5), (0.05, 0.005, 0.3), (0.7, 0.0005, 0.02)]
)
def test_depth_of_a_face_seen_edge_on_has_what_single_precision_moves_and_no_more(cosine, right_mm, wrong_mm):
    """A face through (0.3, 0.2, 1) 3 m ahead, turned about y to this cosine of incidence; its ray is a pixel's centre."""
    view = {"width": 512, "height": 512, "fx": 560.0, "fy": 560.0, "cx": 350.5 - 0.3 * 560, "cy": 300.5 - 0.2 * 560}
    ray = np.array([0.3, 0.2, 1.0])
    aside = np.cross(ray, [0.0, 1.0, 0.0])
    aside, ahead = aside / np.linalg.norm(aside), ray / np.linalg.norm(ray)
    along = cosine * aside + np.sqrt(1.0 - cosine**2) * ahead
    up = np.cross(along, aside)
    corners = 3.0 * ray + np.array([-0.5 * along - 0.3 * up, 0.5 * along - 0.3 * up, 0.6 * up])
    hits = rays.cast(rays.bare_faces(corners[None]), view)
    (number,) = np.flatnonzero(hits.pixel == 300 * 512 + 350)
    assert hits.sure[number]
    assert hits.z[number] == pytest.approx(3.0, abs=1e-9)
    for off_mm in (-right_mm, right_mm):
        assert hits.low[number] < 3.0 + off_mm / 1e3 < hits.high[number]
    assert hits.high[number] - 3.0 < wrong_mm / 1e3 > 3.0 - hits.low[number]

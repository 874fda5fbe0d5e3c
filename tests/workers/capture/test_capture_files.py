"""Files of a capture: the user's folder, what processing writes beside it, and the truth of a simulation, read and refused."""

import io
import json
import os

import cv2
import lzfse
import numpy as np
import OpenEXR
import pytest
import trimesh

from schemas.capture import CaptureCamera, CapturedView, CaptureTruth, Reconstruction
from schemas.errors import CaptureError
from schemas.job.captures import GRID_KEYS, Board
from schemas.job.views import Distortion
from schemas.scene.scene import EffectPlan
from schemas.scene.view import Intrinsics
from tests.workers.capture.simulated import asset_of
from workers.capture.folder import (
    CaptureFile,
    derive_name,
    open_folder,
    read_board,
    read_pose,
    read_view,
    write_description,
    write_pose,
    write_view,
)
from workers.capture.results import (
    cloud_ply,
    digest_inputs,
    mesh_ply,
    read_record,
    read_surface,
    write_results,
    written_files,
)
from workers.capture.truth import read_truth, write_true_mask, write_truth
from workers.geometry.frames import pose, uniform_rotation

K = Intrinsics(width=40, height=30, fx=35.5, fy=35.25, cx=20.25, cy=15.75)
CAMERA = CaptureCamera(K, np.array([0.1, -0.05, 1e-3, 0, 0, 0, 0, 0]))
RNG = np.random.default_rng(0)
DEPTH = RNG.integers(0, 65536, (30, 40)).astype(np.uint16)
VIEW = CapturedView(0, RNG.integers(0, 256, (30, 40, 3), np.uint8), DEPTH, RNG.random((30, 40)) < 0.5)
POINTS = RNG.normal(0, 0.1, (50, 3))
COLORS = RNG.integers(0, 256, (50, 3)).astype(np.uint8)
FACES = RNG.integers(0, 50, (30, 3)).astype(np.int32)
SURFACE = Reconstruction(POINTS, -POINTS, COLORS, RNG.integers(1, 40, 50).astype(np.int32), POINTS, FACES, COLORS)
QUAD = [[-0.05, 0.05, 0.0], [0.05, 0.05, 0.0], [0.05, -0.05, 0.0], [-0.05, -0.05, 0.0]]
GRIDLESS: dict[str, object] = dict.fromkeys(GRID_KEYS)
"""Takes a grid's keys out of board.json."""


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "mug"
    path.mkdir()
    write_description(path, CaptureFile(name="cup", category="mug"), CAMERA, Board(columns=3))
    write_view(path, VIEW)
    write_view(path, CapturedView(3, VIEW.rgb, None, None))
    return path


def refused(folder, reason, words, number=None):
    with pytest.raises(CaptureError, match=words) as error:
        open_folder(folder) if number is None else read_view(open_folder(folder), number)
    assert error.value.reason == reason


def instead(folder, name, data: bytes, *expected) -> None:
    """With other bytes in a file, which comes back."""
    path = folder / name
    before = path.read_bytes() if path.exists() else None
    path.write_bytes(data)
    refused(folder, *expected)
    path.unlink() if before is None else path.write_bytes(before)


def test_what_was_written_is_read(folder):
    opened = open_folder(folder)
    assert opened.numbers == (0, 3) and opened.about.category == "mug" and opened.board.columns == 3
    assert opened.camera.intrinsics == K and np.array_equal(opened.camera.lens, CAMERA.lens) and opened.camera.has_lens
    view = read_view(opened, 0)
    assert all(np.array_equal(getattr(view, name), getattr(VIEW, name)) for name in ("rgb", "depth", "mask"))
    assert read_view(opened, 3).depth is None and read_view(opened, 3).mask is None
    assert read_board(folder / "board.json") == opened.board
    for pixel_centre, cx in (("0", 20.5), ("0.5", 20.0)):
        spec = json.loads((folder / "camera.json").read_text()) | {"cx": 20.0, "pixel_centre": pixel_centre}
        (folder / "camera.json").write_text(json.dumps(spec))
        assert open_folder(folder).camera.intrinsics.cx == cx
    cv2.imwrite(str(folder / "rgb_00000.png"), np.full((30, 40), 77, np.uint8))
    assert (read_view(opened, 0).rgb == 77).all(), "a grey photograph is read as grey colour"
    (folder / "rgb_00003.png").unlink()
    with pytest.raises(CaptureError, match=r"has no rgb_00003\.png"):
        read_view(opened, 3)
    assert derive_name("my cup (2)") == "my_cup_2_" and derive_name("///") == "capture"
    assert len(derive_name("x" * 200)) == 64


def test_a_wrong_or_missing_description_names_file_and_key(folder):
    for name, keys, words in (
        ("camera.json", {"fx": None}, "camera.json: fx: Field required"),
        ("camera.json", {"fx": -1}, "camera.json: fx: Input should be greater than 0"),
        ("camera.json", {"fx": float("nan")}, "camera.json is no JSON: NaN"),
        ("camera.json", {"cx": float("inf")}, "camera.json is no JSON: Infinity"),
        ("camera.json", {"pixel_centre": "1"}, "pixel_centre"),
        ("camera.json", {"distortion": [0.0] * 9}, "distortion has 9 numbers"),
        ("camera.json", {"zoom": 2}, "zoom: Extra inputs"),
        ("board.json", {"marker_m": 0.5}, "columns|width_m is"),
        ("board.json", {"columns": "many"}, "columns"),
        ("board.json", {"measured_ruler_m": 2.0}, "measured_ruler_m over ruler_m is 10"),
        ("board.json", {"markers": [{"id": 1, "corners": QUAD}]}, "columns is of a grid"),
        ("board.json", {"squares": [QUAD]}, "squares stand beside markers"),
        ("board.json", GRIDLESS | {"markers": [{"id": 1, "corners": QUAD}] * 2}, "marker 1 is there twice"),
        ("board.json", GRIDLESS | {"markers": [{"id": 1, "corners": QUAD[1::-1] + QUAD[2:]}]}, "marker 1.* no square"),
        ("board.json", GRIDLESS | {"markers": [{"id": 1, "corners": QUAD[:1] * 4}]}, "marker 1.* no square"),
        ("board.json", GRIDLESS | {"markers": [{"id": 1, "corners": QUAD[::-1]}]}, "all markers face down"),
        ("board.json", GRIDLESS | {"markers": [{"id": 1, "corners": QUAD[:3]}]}, "markers.0.corners"),
        ("board.json", GRIDLESS | {"markers": [{"id": -1, "corners": QUAD}]}, "markers.0.id"),
        (
            "board.json",
            GRIDLESS | {"markers": [{"id": 1, "corners": QUAD}], "width_m": 0.05},
            "marker 1 needs 0.1 about",
        ),
        ("board.json", {"border_bits": 0}, "border_bits"),
        ("capture.json", {"category": "../etc"}, "category"),
        ("capture.json", {"frame": "left"}, "frame"),
    ):
        spec = json.loads((folder / name).read_text()) | keys
        text = json.dumps({key: value for key, value in spec.items() if value is not None})
        instead(folder, name, text.encode(), "unreadable", words)
    for name in ("camera.json", "board.json", "capture.json"):
        for text in (b"", b"{", b"[1]", b"\xff\xfe", b"[" * 100_000, b"null"):
            instead(folder, name, text, "unreadable", name)
    for name in ("board.json", "camera.json"):
        (folder / name).rename(folder / "away")
        refused(folder, "missing", f"has no {name}")
        (folder / "away").rename(folder / name)
    (folder / "camera.json").unlink()
    (folder / "camera.json").mkdir()
    refused(folder, "unreadable", "camera.json cannot be read")
    refused(folder.parent, "missing", "has no rgb_00000.png")
    refused(folder / "nothing", "missing", "there is no such folder")


def test_images_that_do_not_belong_together_or_are_torn_are_refused_by_name(folder):
    data = (folder / "rgb_00000.png").read_bytes()
    for name in ("depth_00007.png", "mask_00007.png", "correction_00009.txt"):
        if name.endswith(".png"):
            (folder / name).write_bytes(data)
        else:
            write_pose(folder / name, np.eye(4))
        kind, _, number = name.partition(".")[0].partition("_")
        refused(folder, "counts", f"{kind}_{number} has no rgb_{number}.png")
        (folder / name).unlink()
    for name in ("rgb_0000.png", "rgb_000003.png"):
        instead(folder, name, data, "name", f"{name} must be named rgb_0000")
    for name in ("rgb_00000.png", "depth_00000.png", "mask_00000.png"):
        whole = (folder / name).read_bytes()
        for keep in (0.0, 0.01, 0.5, 0.98):
            torn = whole[: int(keep * len(whole))]
            instead(folder, name, torn, "unreadable", f"{name} is no image that can be read", 0)
        if not name.startswith("mask"):
            wrong = bytearray(whole)
            wrong[len(wrong) // 2] ^= 0xFF
            instead(folder, name, bytes(wrong), "unreadable", name, 0)
    for name, shape, kind, words in (
        ("rgb_00000.png", (31, 40, 3), np.uint8, "40 x 31 of uint8"),
        ("depth_00000.png", (30, 41), np.uint16, "41 x 30 of uint16"),
        ("depth_00000.png", (30, 40), np.uint8, "uint8, 1 channels, and .*uint16"),
        ("depth_00000.png", (30, 40, 3), np.uint16, "3 channels"),
        ("mask_00000.png", (15, 20), np.uint8, "20 x 15"),
    ):
        image = cv2.imencode(".png", np.zeros(shape, kind))[1].tobytes()
        instead(folder, name, image, "size", words, 0)


def test_poses_and_truth_are_read_back_to_the_bit_and_what_is_none_is_refused(tmp_path):
    rng = np.random.default_rng(4)
    poses = [pose(uniform_rotation(rng), rng.standard_normal(3)) for _ in range(5)]
    path = tmp_path / "board_00000.txt"
    write_pose(path, poses[0])
    assert np.array_equal(read_pose(path), poses[0]) and len(path.read_text().splitlines()) == 4
    assert read_pose(tmp_path / "board_00001.txt") is None and read_truth(tmp_path) is None
    rest = " 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 "
    for text in ("", "1 2 3", "a b c d\n" * 4, f"nan{rest}1", f"2{rest}1", f"-1{rest}1", f"1{rest}2", f"inf{rest}1"):
        path.write_text(text)
        with pytest.raises(CaptureError, match=r"board_00000\.txt"):
            read_pose(path)
    for lens in (None, Distortion(k1=0.1, k3=-0.02)):
        truth = CaptureTruth(np.stack(poses[:3]), poses[3], 1.02, poses[4], 0.01, lens)
        write_truth(tmp_path, truth, asset_of("mug"), EffectPlan(("rgb",), {"exposure": "is off"}))
        again = read_truth(tmp_path)
        for name in ("T_board_cam", "T_board_obj", "T_color_depth"):
            assert np.array_equal(getattr(again, name), getattr(truth, name))
        assert (again.print_scale, again.depth_bias_m, again.lens) == (1.02, 0.01, lens)
    record = json.loads((tmp_path / "truth" / "truth.json").read_text())
    assert (record["effects"], record["skipped"]) == (["rgb"], [{"effect": "exposure", "why": "is off"}])
    assert (tmp_path / "truth" / "mesh.glb").read_bytes().startswith(b"glTF")
    write_true_mask(tmp_path, 12, VIEW.mask)
    image = cv2.imread(str(tmp_path / "truth" / "mask_00012.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(image, np.where(VIEW.mask, 255, 0))
    for text in ("{", "{}", '{"T_board_cam": 3}'):
        (tmp_path / "truth" / "truth.json").write_text(text)
        with pytest.raises(CaptureError, match=r"truth\.json"):
            read_truth(tmp_path)


def test_a_cloud_and_a_mesh_are_read_back_and_trimesh_reads_them_too(tmp_path):
    (tmp_path / "cloud.ply").write_bytes(cloud_ply(SURFACE))
    (tmp_path / "mesh.ply").write_bytes(mesh_ply(SURFACE))
    again = read_surface(tmp_path)
    for name, values in vars(SURFACE).items():
        assert np.allclose(getattr(again, name), values, atol=1e-6)
    for name in ("cloud", "mesh"):
        other = trimesh.load(tmp_path / f"{name}.ply", process=False)
        assert np.allclose(other.vertices, POINTS, atol=1e-7)
    assert np.array_equal(other.faces, SURFACE.faces)


def test_files_that_were_changed_or_given_are_the_users_and_a_run_that_was_cut_off_leaves_none(tmp_path, monkeypatch):
    (tmp_path / "mask_00000.png").write_bytes(b"given")
    users = write_results(tmp_path, {"mask_00000.png": b"a", "mask_00001.png": b"b", "cloud.ply": b"c"}, {"note": 1})
    assert users == ["mask_00000.png"] and (tmp_path / "mask_00000.png").read_bytes() == b"given"
    assert written_files(tmp_path) == {"mask_00001.png", "cloud.ply"}
    (tmp_path / "mask_00001.png").write_bytes(b"changed")
    assert written_files(tmp_path) == {"cloud.ply"}
    users = write_results(tmp_path, {"mask_00001.png": b"z"}, {})
    assert users == ["mask_00001.png"] and (tmp_path / "mask_00001.png").read_bytes() == b"changed"
    assert not (tmp_path / "cloud.ply").exists()  # ours, and not made this time
    assert read_record(tmp_path) == {"files": {}}
    real, calls = os.replace, []

    def fail(source, target):
        calls.append(target)
        if len(calls) == 3:
            raise OSError("cut off")
        real(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("workers.capture.results.os.replace", fail)
        with pytest.raises(OSError, match="cut off"):
            write_results(tmp_path, {"a.png": b"1", "b.png": b"2", "c.png": b"3"}, {})
    assert written_files(tmp_path) == {"a.png"}
    assert write_results(tmp_path, {"a.png": b"1", "b.png": b"2"}, {}) == []
    assert written_files(tmp_path) == {"a.png", "b.png"}


def test_results_that_are_missing_or_damaged_are_refused(tmp_path):
    whole = cloud_ply(SURFACE)
    for data, words in ((None, "verso capture process"), (b"ply nonsense", "is not what"), (whole[:-1], "ends early")):
        if data is not None:
            (tmp_path / "cloud.ply").write_bytes(data)
        with pytest.raises(CaptureError, match=words):
            read_surface(tmp_path)
    assert read_record(tmp_path) is None
    for text in ("{", "[]", '{"files": 3}'):
        (tmp_path / "process.json").write_text(text)
        with pytest.raises(CaptureError, match=r"process\.json"):
            read_record(tmp_path)


def test_every_byte_and_name_of_the_inputs_is_in_their_digest_and_nothing_else(folder):
    spec = json.loads((folder / "board.json").read_text()) | {"dictionary": "mine.yml"}
    (folder / "board.json").write_text(json.dumps(spec))
    (folder / "mine.yml").write_text("markers")
    (folder / "truth").mkdir()
    (folder / "truth" / "truth.json").write_text("{}")
    before = digest_inputs(folder)
    for name in ("rgb_00003.png", "camera.json", "board.json", "mine.yml", "truth/truth.json"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data + b" ")
        assert digest_inputs(folder) != before
        (folder / name).write_bytes(data)
    written = {"cloud.ply": b"c", "mesh.ply": b"m", "board_00000.txt": b"1 0", "correction_00000.txt": b"1 0"}
    assert write_results(folder, written, {}) == []
    (folder / "notes.txt").write_text("mine")
    folder = folder.rename(folder.with_name("elsewhere"))
    assert digest_inputs(folder) == before, "neither the path nor what was written beside it"
    (folder / "correction_00000.txt").write_text("1 1")
    digests = {before, digest_inputs(folder)}  # what the user changed among the results is an input
    (folder / "mask_00003.png").write_text("m")
    digests.add(digest_inputs(folder))
    (folder / "mask_00003.png").rename(folder / "mask_00001.png")
    digests.add(digest_inputs(folder))
    (folder / "rgb_00003.png").unlink()
    assert len(digests | {digest_inputs(folder)}) == 5
    with pytest.raises(CaptureError, match="nowhere"):
        digest_inputs(folder / "nowhere")


# ---------------------------------------------------------------------------------------------- other cameras and files

WIDE = Intrinsics(width=160, height=120, fx=110.0, fy=112.0, cx=81.3, cy=58.2)


def described(path, view=None, **changes):
    """The folder with a camera.json of WIDE and these keys, and an image of a view unless it has one."""
    path.mkdir(exist_ok=True)
    spec = WIDE.model_dump() | {"pixel_centre": "0.5"} | changes
    (path / "camera.json").write_text(json.dumps(spec))
    (path / "board.json").write_text("{}")
    if not (path / "rgb_00000.png").exists() and not (path / "rgb_00000.jpg").exists():
        cv2.imwrite(
            str(path / "rgb_00000.png"), np.zeros((WIDE.height, WIDE.width, 3), np.uint8) if view is None else view
        )
    return open_folder(path)


def spot(at):
    """A picture with a blurred spot about a pixel (first centre at +0.5)."""
    v, u = np.mgrid[: WIDE.height, : WIDE.width] + 0.5
    light = 250 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * 2.5**2))
    return np.repeat(np.rint(light).astype(np.uint8)[..., None], 3, axis=2)


def middle(rgb):
    weight = rgb[..., 0].astype(float)
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]] + 0.5
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


POINT = np.array([0.21, -0.14, 0.8])
"""In camera axes, off the optical axis, so that every lens bends its ray."""
STRAIGHT = np.array([WIDE.fx * POINT[0] / POINT[2] + WIDE.cx, WIDE.fy * POINT[1] / POINT[2] + WIDE.cy])


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("opencv", [0.3, -0.1, 5e-3, -8e-3, 0.02, 0.01, 0, 0, 0.05, -0.01, 0.04, 0.005]),
        ("opencv", [0.3, -0.1, 5e-3, -8e-3, 0.02, 0.01, 0, 0, 0.05, -0.01, 0.04, 0.005, 0.02, -0.06]),
        ("fisheye", [0.05, -0.02, 0.01, 0.0]),
    ],
)
def test_a_lens_that_the_steps_do_not_know_is_taken_out_of_what_is_read(model, lens, tmp_path):
    """A point's spot is drawn where OpenCV projects the point, and is read where a pinhole has it."""
    K = np.array([[WIDE.fx, 0, WIDE.cx - 0.5], [0, WIDE.fy, WIDE.cy - 0.5], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    zero = np.zeros(3)
    pixels, _ = project(POINT.reshape(1, 1, 3), zero, zero, K, np.array(lens))
    at = pixels.ravel() + 0.5
    assert np.linalg.norm(at - STRAIGHT) > 0.8, "the lens bends enough to be told"
    if model == "opencv":
        shorter = {12: 8, 14: 12}[len(lens)]
        less, _ = cv2.projectPoints(POINT.reshape(1, 1, 3), zero, zero, K, np.array(lens[:shorter]))
        assert np.linalg.norm(less.ravel() + 0.5 - at) > 0.3, "and so do its last numbers"
    path = tmp_path / "capture"
    folder = described(path, spot(at), distortion=lens, lens_model=model)
    cv2.imwrite(str(path / "mask_00000.png"), (spot(at)[..., 0] > 100).astype(np.uint8) * 255)
    cv2.imwrite(str(path / "depth_00000.png"), np.where(spot(at)[..., 0] > 100, 800, 0).astype(np.uint16))
    view = read_view(folder, 0)
    assert not folder.camera.has_lens and folder.camera.intrinsics == WIDE
    assert np.linalg.norm(middle(view.rgb) - STRAIGHT) < 0.15
    for region in (view.mask, view.depth == 800):
        assert np.linalg.norm(np.argwhere(region).mean(axis=0)[::-1] + 0.5 - STRAIGHT) < 0.5
    for known in ([0.1, -0.05, 1e-3, 0], [0.1, -0.05, 1e-3, 0, 0.02], [0.1, -0.05, 1e-3, 0, 0.02, 0.01, 0, 0]):
        kept = described(path, distortion=known)
        assert kept.camera.lens[: len(known)].tolist() == known, "and is kept in the picture as it was"


def test_a_view_with_intrinsics_of_its_own_is_read_as_the_others(tmp_path):
    path = tmp_path / "capture"
    own = {"fx": 104.0, "fy": 107.0, "cx": 79.0, "cy": 61.0}
    at = np.array([own["fx"] * POINT[0] / POINT[2] + own["cx"], own["fy"] * POINT[1] / POINT[2] + own["cy"]])
    folder = described(path, spot(at))
    (path / "camera_00000.json").write_text(json.dumps(own))
    assert np.linalg.norm(middle(read_view(folder, 0).rgb) - STRAIGHT) < 0.1
    (path / "camera_00000.json").write_text("{}")
    with pytest.raises(CaptureError, match=r"camera_00000\.json: fx: Field required"):
        read_view(folder, 0)
    (path / "camera_00000.json").rename(path / "camera_00007.json")
    with pytest.raises(CaptureError, match=r"camera_00007 has no rgb_00007"):
        open_folder(path)


def test_depth_of_any_encoding_and_colour_as_jpeg_are_read(tmp_path):
    path = tmp_path / "capture"
    path.mkdir()

    def exr(**channels: np.ndarray) -> bytes:
        head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(head, channels).write(str(tmp_path / "written.exr"))
        return (tmp_path / "written.exr").read_bytes()

    metres = np.round(0.5 + 2 * RNG.random((WIDE.height, WIDE.width)), 3)
    metres[RNG.random(metres.shape) < 0.2] = 0
    ramp = np.repeat(np.linspace(20, 200, WIDE.width).astype(np.uint8)[None, :, None], WIDE.height, 0).repeat(3, 2)
    (path / "rgb_00000.jpg").write_bytes(cv2.imencode(".jpg", ramp)[1].tobytes())
    folder, single = described(path), metres.astype(np.float32)
    units = np.rint(1000 * metres).astype(np.uint16)
    written = io.BytesIO()
    np.save(written, single)
    whole_numbers = io.BytesIO()
    np.save(whole_numbers, units)
    with_nan = single.copy()
    with_nan[0, 0] = np.nan
    for ending, data in (
        ("npy", written.getvalue()),
        ("npy", whole_numbers.getvalue()),
        ("tif", cv2.imencode(".tiff", single)[1].tobytes()),
        ("tiff", cv2.imencode(".tiff", units)[1].tobytes()),
        ("exr", exr(V=single)),
        ("exr", exr(Z=with_nan, R=0 * single, G=0 * single, B=0 * single)),
        ("depth", single.tobytes()),
        ("depth", units.tobytes()),
        ("depth", lzfse.compress(single.tobytes())),
        ("depth", with_nan.tobytes()),
    ):
        file = path / f"depth_00000.{ending}"
        file.write_bytes(data)
        view = read_view(folder, 0)
        assert view.depth.dtype == np.uint16
        assert np.array_equal(view.depth[1:], units[1:]), ending
        assert digest_inputs(path)
        file.unlink()
    assert np.abs(view.rgb.astype(int) - ramp).max() <= 4  # a smooth picture through JPEG of the usual quality
    size = f"{WIDE.width} x {WIDE.height}"
    bomb = (
        b"\x93NUMPY\x01\0v\0"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999, 9999), }".ljust(117)
        + b"\n"
    )
    objects = io.BytesIO()
    np.save(objects, np.full((WIDE.height, WIDE.width), None), allow_pickle=True)
    for ending, data, told in (
        ("exr", b"v/1\x01" + bytes(100), "is OpenEXR, and cut or altered"),
        ("exr", exr(Z=single)[:-9], "is OpenEXR, and cut or altered"),
        ("exr", exr(Z=single[:50]), f"is 160 x 50, and its camera has {size}"),
        (
            "exr",
            exr(R=single, G=single, B=single),
            "has the channels B, G, R: depth is one channel, or the one named Z",
        ),
        ("exr", exr(Z=single.astype(np.uint32)), "is uint32 with 1 channels"),
        ("npy", bomb, "holds .99999999, 9999. of float64"),
        ("npy", objects.getvalue(), "of object"),
        ("npy", written.getvalue()[:200], f"its camera has {size}"),
        ("npy", b"\x93NUMPY", "is no .npy that can be read"),
        ("depth", bytes(77), f"has 77 bytes, and depth of {size} has 76800"),
        ("depth", b"bvx2" + bytes(50), "compressed by LZFSE, and cut or altered"),
        ("tif", b"II*\0" + bytes(50), "is no image that can be read"),
        ("tif", cv2.imencode(".tiff", single[:50])[1].tobytes(), f"is 160 x 50, and its camera has {size}"),
        ("tif", cv2.imencode(".tiff", ramp)[1].tobytes(), "uint8 with 3 channels: depth has one"),
        ("png", cv2.imencode(".png", units[:50])[1].tobytes(), "another size of depth: describe depth_camera"),
    ):
        (path / f"depth_00000.{ending}").write_bytes(data)
        with pytest.raises(CaptureError, match=told):
            read_view(folder, 0)
        (path / f"depth_00000.{ending}").unlink()
    (path / "rgb_00000.png").write_bytes(b"")
    with pytest.raises(CaptureError, match="has two files rgb_00000: keep one"):
        open_folder(path)


def test_depth_of_a_camera_of_its_own_is_registered_to_colour(tmp_path):
    """Of a slanted plane n p = d, whose depth each camera's rays tell; the depth camera stands aside and is turned."""
    path, k = tmp_path / "capture", Intrinsics(width=100, height=80, fx=70.0, fy=71.0, cx=50.5, cy=40.5)
    T_color_depth = pose(cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0], np.array([-0.03, 0.01, 0.004]))
    n, d = np.array([0.2, -0.1, 1.0]), 0.9

    def rays(camera):
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)

    turned = T_color_depth[:3, :3].T @ n
    seen = (d - n @ T_color_depth[:3, 3]) / (rays(k) @ turned)
    spec = k.model_dump() | {"T_color_depth": T_color_depth.tolist()}
    folder = described(path, depth_camera=spec, depth_units_per_m=10_000.0)
    np.save(path / "depth_00000.npy", seen)
    view = read_view(folder, 0)
    true = d / (rays(WIDE) @ n)
    filled = view.depth > 0
    assert filled[20:-20, 20:-20].all() and np.abs(view.depth / 10_000 - true)[filled].max() < 1e-4
    for change, told in (
        ({"T_color_depth": np.diag([1.0, 1, 2, 1]).tolist()}, "no rigid transform"),
        ({"T_color_depth": [[1.0] * 4] * 3}, "depth_camera.T_color_depth"),
        ({"fx": 0}, "depth_camera.fx"),
    ):
        with pytest.raises(CaptureError, match=told):
            described(path, depth_camera=spec | change)
    for lens, model in (([0.0] * 9, "opencv"), ([0.0] * 13, "opencv"), ([0.0] * 5, "fisheye"), ([], "fisheye")):
        with pytest.raises(CaptureError, match=f"distortion has {len(lens)} numbers: OpenCV's lenses have"):
            described(path, distortion=lens, lens_model=model)

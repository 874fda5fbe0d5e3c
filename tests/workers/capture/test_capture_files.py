"""Files of a capture: the user's folder, what processing writes beside it, and the truth of a simulation, read and refused."""

import json
import os

import cv2
import numpy as np
import pytest
import trimesh

from schemas.capture import CaptureCamera, CapturedView, CaptureTruth
from schemas.errors import CaptureError
from schemas.job.captures import GRID_KEYS, Board
from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics
from workers.capture.folder import (
    CaptureFile,
    TrueObject,
    derive_name,
    open_folder,
    read_board,
    read_pose,
    read_truth,
    read_view,
    write_description,
    write_pose,
    write_true_mask,
    write_truth,
    write_view,
)
from workers.capture.results import (
    cloud_ply,
    digest_inputs,
    list_inputs,
    mesh_ply,
    own_files,
    read_cloud,
    read_mesh,
    read_record,
    write_results,
)
from workers.geometry.frames import pose, uniform_rotation

K = Intrinsics(width=40, height=30, fx=35.5, fy=35.25, cx=20.25, cy=15.75)
CAMERA = CaptureCamera(K, np.array([0.1, -0.05, 1e-3, 0, 0, 0, 0, 0]))
RNG = np.random.default_rng(0)
DEPTH = RNG.integers(0, 65536, (30, 40)).astype(np.uint16)
VIEW = CapturedView(0, RNG.integers(0, 256, (30, 40, 3), np.uint8), DEPTH, RNG.random((30, 40)) < 0.5)
POINTS = RNG.normal(0, 0.1, (50, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1)[:, None]
COLORS = RNG.integers(0, 256, (50, 3)).astype(np.uint8)
VIEWS = RNG.integers(1, 40, 50).astype(np.int32)
FACES = RNG.integers(0, 50, (30, 3)).astype(np.int32)
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
        ("camera.json", {"distortion": [0.0] * 9}, "distortion"),
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
    refused(folder / "nothing", "missing", "is no folder")


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
        write_truth(tmp_path, truth, TrueObject("mug", "mug-3", b"glTF"), ("rgb",), {"exposure": "is off"})
        again = read_truth(tmp_path)
        for name in ("T_board_cam", "T_board_obj", "T_color_depth"):
            assert np.array_equal(getattr(again, name), getattr(truth, name))
        assert (again.print_scale, again.depth_bias_m, again.lens) == (1.02, 0.01, lens)
    record = json.loads((tmp_path / "truth" / "truth.json").read_text())
    assert (record["effects"], record["skipped"]) == (["rgb"], [{"effect": "exposure", "why": "is off"}])
    assert (tmp_path / "truth" / "mesh.glb").read_bytes() == b"glTF"
    write_true_mask(tmp_path, 12, VIEW.mask)
    image = cv2.imread(str(tmp_path / "truth" / "mask_00012.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(image, np.where(VIEW.mask, 255, 0))
    for text in ("{", "{}", '{"T_board_cam": 3}'):
        (tmp_path / "truth" / "truth.json").write_text(text)
        with pytest.raises(CaptureError, match=r"truth\.json"):
            read_truth(tmp_path)


def test_a_cloud_and_a_mesh_are_read_back_and_trimesh_reads_them_too(tmp_path):
    (tmp_path / "cloud.ply").write_bytes(cloud_ply(POINTS, NORMALS, COLORS, VIEWS))
    points, normals, colors, views = read_cloud(tmp_path)
    assert np.allclose(points, POINTS, atol=1e-7) and np.allclose(normals, NORMALS, atol=1e-6)
    assert np.array_equal(colors, COLORS) and np.array_equal(views, VIEWS)
    other = trimesh.load(tmp_path / "cloud.ply")
    assert np.allclose(other.vertices, POINTS, atol=1e-7) and np.array_equal(np.asarray(other.colors)[:, :3], COLORS)
    (tmp_path / "mesh.ply").write_bytes(mesh_ply(POINTS, FACES, COLORS))
    vertices, faces, colors = read_mesh(tmp_path)
    assert np.allclose(vertices, POINTS, atol=1e-7) and np.array_equal(faces, FACES) and np.array_equal(colors, COLORS)
    other = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert np.allclose(other.vertices, POINTS, atol=1e-7) and np.array_equal(other.faces, FACES)


def test_files_that_were_changed_or_given_are_the_users_and_a_run_that_was_cut_off_leaves_none(tmp_path, monkeypatch):
    (tmp_path / "mask_00000.png").write_bytes(b"given")
    users = write_results(tmp_path, {"mask_00000.png": b"a", "mask_00001.png": b"b", "cloud.ply": b"c"}, {"note": 1})
    assert users == ["mask_00000.png"] and (tmp_path / "mask_00000.png").read_bytes() == b"given"
    assert own_files(tmp_path) == {"mask_00001.png", "cloud.ply"}
    (tmp_path / "mask_00001.png").write_bytes(b"changed")
    assert own_files(tmp_path) == {"cloud.ply"}
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
    assert own_files(tmp_path) == {"a.png"}
    assert write_results(tmp_path, {"a.png": b"1", "b.png": b"2"}, {}) == []
    assert own_files(tmp_path) == {"a.png", "b.png"}


def test_results_that_are_missing_or_damaged_are_refused(tmp_path):
    def refused_cloud(words):
        with pytest.raises(CaptureError, match=words):
            read_cloud(tmp_path)

    refused_cloud("verso capture process")
    (tmp_path / "cloud.ply").write_bytes(b"ply nonsense")
    refused_cloud("is not what `verso capture process` wrote")
    (tmp_path / "cloud.ply").write_bytes(cloud_ply(POINTS, NORMALS, COLORS, VIEWS)[:-1])
    refused_cloud("ends early")
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
    names = [file.relative_to(folder).as_posix() for file in list_inputs(folder)]
    assert names == sorted(names) and "mine.yml" in names
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

"""`verso score` from the command line: truth is perfect, each fault is an item with a reason, scores are compared and kept."""

import importlib.util
import io
import json
import os
import re
import shutil
import struct
import zipfile

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

from services.cli.main import main
from services.dataset.dataset import open_dataset
from services.score import run as module
from workers.pool import Ended

PAIRS = 8
"""Of the dataset `files`."""


def write_truth(files, folder, change=lambda depth_m, number: depth_m):
    """What is true of each pair as its prediction: depth in metres, RGB, and shapes in the object's frame."""
    for kind in ("depth", "rgb", "shape"):
        (folder / kind).mkdir(parents=True)
    for number, pair in enumerate(open_dataset(str(files.root)).pairs()):
        name = f"{pair.mirror.pose_id:05d}"
        depth_m = pair.mirror.depth() / pair.mirror.depth_units_per_m
        np.save(folder / "depth" / f"{name}.npy", change(depth_m, number))
        cv2.imwrite(str(folder / "rgb" / f"{name}.png"), pair.mirror.rgb()[..., ::-1])
        mesh = pair.mesh(3, welded=True)
        T_obj_world = np.linalg.inv(pair.T_world[3])
        vertices = np.asarray(mesh.vertices) @ T_obj_world[:3, :3].T + T_obj_world[:3, 3]
        trimesh.Trimesh(vertices, mesh.faces, process=False).export(folder / "shape" / f"{name}.ply")
    return folder


@pytest.fixture(scope="module")
def truth(files, tmp_path_factory):
    return write_truth(files, tmp_path_factory.mktemp("truth") / "predictions")


def score(capsys, *words):
    """(exit status, answer, what was said of faults)."""
    capsys.readouterr()
    status = main(["score", *map(str, words), "--json"])
    told = capsys.readouterr()
    return status, json.loads(told.out.splitlines()[-1]), told.err


def test_truth_is_perfect_and_its_page_needs_no_network(files, truth, tmp_path, capsys):
    status, answer, _ = score(capsys, files.root, truth, "--out", tmp_path)
    assert (status, answer["items"], answer["missing"], answer["refused"]) == (0, 3 * PAIRS, 0, 0)
    value = {name: one["value"] for name, one in answer["metrics"].items()}
    assert value["depth_mae_m"] == value["depth_mae_hidden_m"] == value["depth_mae_scene_m"] == 0.0
    assert value["depth_within_2mm"] == value["rgb_ssim"] == value["shape_fscore_2mm"] == 1.0
    assert value["shape_iou"] == pytest.approx(1.0, abs=1e-6) and value["shape_chamfer_l1_m"] < 1e-6
    page = (tmp_path / "index.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page
    rows = pq.read_table(tmp_path / "items.parquet").to_pylist()
    assert len(rows) == 3 * PAIRS and {row["status"] for row in rows} == {"ok"}


def test_what_this_installation_cannot_score_is_told_before_anything_is_written(
    files, truth, tmp_path, capsys, monkeypatch
):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "flip_evaluator" else find(name, *a)
    )
    status, _, told = score(capsys, files.root, truth, "--out", tmp_path / "new", "--flip")
    assert status == 1 and "`verso extra study` installs it" in told and not (tmp_path / "new").exists()


def archive(path, flags=0, method=0, shape=(4, 3)):
    """An npz of points that says what is not so of itself."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("points.npy", header.getvalue() + bytes(96))
    data = bytearray(path.read_bytes())
    for at in (6, data.index(b"PK\x01\x02") + 8):  # the file's own header, and the list at the end
        data[at : at + 4] = struct.pack("<HH", flags, method or int.from_bytes(data[at + 2 : at + 4], "little"))
    path.write_bytes(data)


def cut(path, keep):
    path.write_bytes(path.read_bytes()[:keep])


def invert_depth(path):
    far = np.load(path)
    np.save(path, np.divide(1.0, far, out=np.zeros_like(far), where=far > 0.0))


def bomb(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("points.npy", b"\0" * 200_000_000)


def twice(path):
    cv2.imwrite(str(path.with_suffix(".png")), np.zeros(np.load(path).shape, np.uint16))


def become_a_pipe(path):
    path.unlink()
    os.mkfifo(path)


FAULTS = [
    ("depth", ".npy", lambda path: np.save(path, np.load(path) * 1000.0), "millimetres"),
    ("depth", ".npy", lambda path: np.save(path, np.load(path)[:50]), r"\(50, 160\)"),
    ("depth", ".npy", invert_depth, "inverted"),
    ("depth", ".npy", lambda path: cut(path, 500), "cannot be read"),
    ("depth", ".npy", lambda path: np.save(path, np.array([{}], dtype=object), allow_pickle=True), "allow_pickle"),
    ("depth", ".npy", twice, "there 2 times"),
    ("depth", ".npy", lambda path: path.write_bytes(b"\x93NUMPY\x01\x00\x28\x23" + b"(" * 9000), "cannot be read"),
    ("rgb", ".png", lambda path: cut(path, -40), "torn|damaged|cut"),
    ("rgb", ".png", lambda path: (path.unlink(), path.mkdir()), "is a folder"),
    ("rgb", ".png", become_a_pipe, "is a pipe"),
    ("rgb", ".png", lambda path: (path.unlink(), path.symlink_to("/dev/zero")), "is a device"),
    ("rgb", ".png", lambda path: (path.unlink(), path.symlink_to("nowhere")), "No such file"),
    ("rgb", ".png", lambda path: os.truncate(path, 6 << 30), "no more are read"),
    ("shape", ".ply", lambda path: trimesh.load(path, process=False).apply_scale(1e3).export(path), "millimetres"),
    (
        "shape",
        ".ply",
        lambda path: path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"),
        "vertices",
    ),
    ("shape", ".npz", bomb, "unpacks to 200 MB"),
    ("shape", ".npz", lambda path: archive(path, shape=(10**12, 3)), "more memory than there is"),
    ("shape", ".npz", lambda path: archive(path, flags=1), "encrypted"),
    ("shape", ".npz", lambda path: archive(path, method=99), "not supported"),
    ("shape", ".npz", lambda path: archive(path, shape=(5, 3)), "cannot be read"),
]
"""Kind of prediction, suffix, what is done to the file of the truth, and what is told."""


def test_each_fault_is_an_item_with_its_reason_and_counts_as_worst(files, truth, tmp_path, capsys):
    folder = shutil.copytree(truth, tmp_path / "spoilt")
    waiting = {kind: sorted((folder / kind).iterdir()) for kind in ("depth", "rgb", "shape")}
    expected = {}
    for kind, suffix, spoil, told in FAULTS:
        path = waiting[kind].pop(0)
        expected[kind, int(path.stem)] = told
        path = path if path.suffix == suffix else path.rename(path.with_suffix(suffix))
        spoil(path)
    waiting["rgb"].pop().unlink()
    shutil.copy(waiting["depth"][0], folder / "depth" / "90001.npy")
    shutil.copy(waiting["depth"][0], os.fsencode(folder / "depth") + b"/\xff.npy")
    (folder / "poses.csv").write_text(f"scene_id,im_id,obj_id,R,t\n1,{10**30},3,1 0 0 0 1 0 0 0 1,0 0 1000\n")
    status, answer, said = score(capsys, files.root, folder, "--out", tmp_path / "score")
    rows = pq.read_table(tmp_path / "score" / "items.parquet").to_pylist()
    refused = {(row["kind"], row["pose_id"]): row["reason"] for row in rows if row["status"] == "refused"}
    for key, told in expected.items():
        assert re.search(told, refused.pop(key)), key
    others = {("depth", 90001): "another dataset", ("depth", None): "no pose id", ("pose", None): "line 2 of poses.csv"}
    assert set(refused) == set(others) and all(others[key] in why for key, why in refused.items())
    assert (status, answer["refused"], answer["missing"]) == (1, len(FAULTS) + 3, 1 + PAIRS)
    assert "missing" in said and answer["metrics"]["depth_mae_m"]["value"] > 0.0
    share = pytest.approx(1 / (PAIRS + 2))  # of eight, one of another dataset, and one without an id
    assert answer["metrics"]["depth_within_2mm"]["value"] == share


def test_an_item_that_ends_its_process_is_refused_and_the_others_are_scored(
    files, truth, tmp_path, capsys, monkeypatch
):
    deadly, real = min(int(path.stem) for path in (truth / "depth").iterdir()), module._answers

    def answers(ranges, kept):
        for item, answer in real(ranges, kept):
            ends = deadly in item.poses and not item.blame
            yield item, Ended("crashed", "crashes its process (SIGSEGV)") if ends else answer

    monkeypatch.setattr(module, "_answers", answers)
    status, answer, said = score(capsys, files.root, truth, "--out", tmp_path)
    assert (status, answer["items"], answer["refused"], answer["missing"]) == (1, 3 * PAIRS, 3, 0)
    assert said.count(f"{deadly:05d} refused: scoring it crashes its process (SIGSEGV)") == 3
    monkeypatch.setattr(module, "_answers", lambda ranges, kept: ((item, Ended("killed", "killed")) for item in ranges))
    assert main(["score", str(files.root), str(truth), "--out", str(tmp_path)]) == 1
    assert "start again, what is scored is kept" in capsys.readouterr().err


def test_the_better_of_two_is_told_and_what_was_scored_is_kept(files, truth, tmp_path, capsys):
    near = write_truth(files, tmp_path / "near", lambda depth_m, _: depth_m + 0.001 * (depth_m > 0))
    far = write_truth(files, tmp_path / "far", lambda depth_m, n: depth_m + (0.004 + 0.0001 * n) * (depth_m > 0))
    answers = [score(capsys, files.root, folder)[1] for folder in (near, far)]
    assert answers[0]["metrics"]["depth_mae_m"]["value"] == pytest.approx(0.001, abs=1e-6)
    assert answers[1]["metrics"]["depth_mae_m"]["low"] < 0.00435 < answers[1]["metrics"]["depth_mae_m"]["high"]
    summary = json.loads((far / "score" / "summary.json").read_text())
    assert len(summary["by"]["category"]) > 1
    for groups in filter(
        None, summary["by"].values()
    ):  # each item is in one group of a kind, and their means are the whole's
        depth = [group["depth_mae_m"] for group in groups.values() if group["depth_mae_m"]["items"]]
        total = sum(part["value"] * part["items"] for part in depth)
        whole = summary["metrics"]["depth_mae_m"]
        assert sum(part["items"] for part in depth) == whole["items"]
        assert total / whole["items"] == pytest.approx(whole["value"])
    scaled = write_truth(files, tmp_path / "scaled", lambda depth_m, _: 3.0 * depth_m)
    answer = score(capsys, files.root, scaled, "--align", "scale")[1]
    assert answer["refused"] == 0 and answer["metrics"]["depth_mae_scene_m"]["value"] < 1e-9
    assert main(["score", str(files.root), "--compare", str(near), str(scaled)]) == 2
    assert "--align none and scale" in capsys.readouterr().err
    found = score(capsys, files.root, "--compare", near, far)[1]["metrics"]
    assert found["depth_mae_m"]["better"] == "a" and found["rgb_ssim"]["better"] is None
    kept = (near / "score" / module.KEPT).stat()
    assert score(capsys, files.root, near)[1] == answers[0]
    assert (near / "score" / module.KEPT).stat() == kept
    first = min((near / "depth").glob("*.npy"))
    time_of_change = first.stat().st_mtime_ns
    np.save(first, np.load(first) + 0.01)
    os.utime(first, ns=(time_of_change, time_of_change))  # as where the clock was set back
    assert score(capsys, files.root, near)[1]["metrics"]["depth_mae_m"]["value"] > 0.002


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "name the folder of predictions"),
        (["nothing"], "has no predictions"),
        (["--compare", "nothing", "nothing"], "has no score"),
    ],
)
def test_what_cannot_be_scored_is_told(files, words, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nothing").mkdir()
    assert main(["score", str(files.root), *words]) == 2
    assert told in capsys.readouterr().err

"""`verso score` from the command line: truth is perfect, each fault is an item with a reason, scores are compared and kept."""

import json
import os
import re
import shutil
import zipfile

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

from services.cli.main import main
from services.dataset.dataset import open_dataset

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


def spoil(folder):
    """Eleven faults, and one prediction that is missing."""
    depth = sorted((folder / "depth").glob("*.npy"))
    values = np.load(depth[0])
    np.save(depth[0], values * 1000.0)
    np.save(depth[1], values[:50])
    far = np.load(depth[2])
    np.save(depth[2], np.divide(1.0, far, out=np.zeros_like(far), where=far > 0.0))
    depth[3].write_bytes(depth[3].read_bytes()[:500])
    np.save(depth[4], np.array([{"a": 1}], dtype=object), allow_pickle=True)
    cv2.imwrite(str(depth[5].with_suffix(".png")), np.zeros(values.shape, np.uint16))
    np.save(folder / "depth" / "90001.npy", values)
    depth[6].unlink()
    shape = sorted((folder / "shape").glob("*.ply"))
    trimesh.load(shape[0], process=False).apply_scale(1000.0).export(shape[0])
    shape[1].write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    shape[2].unlink()
    with zipfile.ZipFile(shape[2].with_suffix(".npz"), "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("points.npy", b"\0" * 200_000_000)
    rgb = sorted((folder / "rgb").glob("*.png"))
    rgb[0].write_bytes(rgb[0].read_bytes()[:-40])


def test_each_fault_is_an_item_with_its_reason_and_counts_as_worst(files, truth, tmp_path, capsys):
    folder = shutil.copytree(truth, tmp_path / "spoilt")
    spoil(folder)
    status, answer, said = score(capsys, files.root, folder, "--out", tmp_path / "score")
    assert (status, answer["refused"], answer["missing"]) == (1, 11, 1)
    rows = pq.read_table(tmp_path / "score" / "items.parquet").to_pylist()
    reasons = [row["reason"] for row in rows if row["status"] == "refused"]
    for told in (
        "millimetres",
        r"\(50, 160\)",
        "inverted",
        "torn|cut|damaged|read",
        "pickle|objects",
        "there 2 times",
        "90001",
        "unpacks to 200 MB",
    ):
        assert sum(bool(re.search(told, reason)) for reason in reasons) >= 1, (told, reasons)
    assert "missing" in said and answer["metrics"]["depth_mae_m"]["value"] > 0.0
    assert answer["metrics"]["depth_within_2mm"]["value"] == pytest.approx(
        1 / PAIRS
    )  # of seven, and one of another dataset


def test_the_better_of_two_is_told_and_what_was_scored_is_kept(files, truth, tmp_path, capsys):
    near = write_truth(files, tmp_path / "near", lambda depth_m, _: depth_m + 0.001 * (depth_m > 0))
    far = write_truth(files, tmp_path / "far", lambda depth_m, n: depth_m + (0.004 + 0.0001 * n) * (depth_m > 0))
    answers = [score(capsys, files.root, folder)[1] for folder in (near, far)]
    assert answers[0]["metrics"]["depth_mae_m"]["value"] == pytest.approx(0.001, abs=1e-6)
    assert answers[1]["metrics"]["depth_mae_m"]["low"] < 0.00435 < answers[1]["metrics"]["depth_mae_m"]["high"]
    scaled = write_truth(files, tmp_path / "scaled", lambda depth_m, _: 3.0 * depth_m)
    answer = score(capsys, files.root, scaled, "--align", "scale")[1]
    assert answer["refused"] == 0 and answer["metrics"]["depth_mae_scene_m"]["value"] < 1e-9
    assert main(["score", str(files.root), "--compare", str(near), str(scaled)]) == 2
    assert "--align none and scale" in capsys.readouterr().err
    found = score(capsys, files.root, "--compare", near, far)[1]["metrics"]
    assert found["depth_mae_m"]["better"] == "a" and found["rgb_ssim"]["better"] is None
    kept = {path.name: path.stat().st_mtime_ns for path in (near / "score" / "_kept").iterdir()}
    assert score(capsys, files.root, near)[1] == answers[0]
    assert {path.name: path.stat().st_mtime_ns for path in (near / "score" / "_kept").iterdir()} == kept
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

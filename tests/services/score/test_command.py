"""`verso score` from the command line: truth is perfect, each fault is an item with a reason, scores are compared and kept."""

import fcntl
import html
import importlib.util
import io
import itertools
import json
import os
import re
import shutil
import struct
import zipfile
from pathlib import Path
from typing import get_args

import cv2
import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh

from schemas.errors import InputError
from schemas.job.assets import SPLITS
from services.cli.main import main
from services.cli.rows import READ_AS
from services.dataset.dataset import open_dataset
from services.score import run as module
from services.score.command import page_of
from services.score.items import FRAMES, LEVELS, Asked, Volume
from services.score.leaderboard import compare_all, describe_verdicts
from services.score.summary import HEADLINES, decide, is_better_high, items_of, summarise
from tests.datasets import make_dataset
from workers.pool import Ended

PAIRS = 8
"""Of the dataset `files`."""


def write_depth(files, folder, change=lambda depth_m, number: depth_m):
    """The true depth of each pair, metres, changed, as its prediction."""
    (folder / "depth").mkdir(parents=True)
    for number, pair in enumerate(open_dataset(str(files.root)).pairs()):
        depth_m = pair.mirror.depth() / pair.mirror.depth_units_per_m
        np.save(folder / "depth" / f"{pair.mirror.pose_id:05d}.npy", change(depth_m, number))
    return folder


def write_truth(files, folder):
    """What is true of each pair as its prediction: depth, RGB, and shapes in the object's frame."""
    write_depth(files, folder)
    for kind in ("rgb", "shape"):
        (folder / kind).mkdir()
    for pair in open_dataset(str(files.root)).pairs():
        name = f"{pair.mirror.pose_id:05d}"
        cv2.imwrite(str(folder / "rgb" / f"{name}.png"), pair.mirror.rgb()[..., ::-1])
        mesh = pair.mesh(3, welded=True)
        T_obj_world = np.linalg.inv(pair.T_world[3])
        vertices = np.asarray(mesh.vertices) @ T_obj_world[:3, :3].T + T_obj_world[:3, 3]
        trimesh.Trimesh(vertices, mesh.faces, process=False).export(folder / "shape" / f"{name}.ply")
    return folder


@pytest.fixture(scope="module")
def truth(files, tmp_path_factory):
    return write_truth(files, tmp_path_factory.mktemp("truth") / "predictions")


@pytest.fixture(scope="module")
def depths(files, tmp_path_factory):
    """The true depth alone, which takes a tenth of the time."""
    return write_depth(files, tmp_path_factory.mktemp("depths") / "predictions")


def score(capsys, *words):
    """(exit status, answer, what was said of faults)."""
    capsys.readouterr()
    status = main(["score", *map(str, words), "--json"])
    told = capsys.readouterr()
    return status, json.loads(told.out.splitlines()[-1]), told.err


def test_truth_is_perfect_and_its_page_needs_no_network(files, truth, tmp_path, capsys):
    status, answer, _ = score(capsys, files.root, truth, "--out", tmp_path)
    assert (status, answer["items"], answer["missing"], answer["refused"]) == (0, 3 * PAIRS, 0, 0)
    assert answer["hidden_by"] == "image"
    value = {name: one["value"] for name, one in answer["metrics"].items()}
    assert value["depth_mae_m"] == value["depth_mae_hidden_m"] == value["depth_mae_scene_m"] == 0.0
    assert value["depth_within_2mm"] == value["rgb_ssim"] == value["rgb_ncc"] == value["shape_fscore_2mm"] == 1.0
    assert value["shape_iou"] == pytest.approx(1.0, abs=1e-6) and value["shape_chamfer_l1_m"] < 1e-6
    page = (tmp_path / "index.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page
    assert all(one["coverage"] == 1.0 for one in answer["metrics"].values() if one["items"])
    rows = pq.read_table(tmp_path / "items.parquet").to_pylist()
    assert len(rows) == 3 * PAIRS and {row["status"] for row in rows} == {"ok"}


@pytest.mark.minute
def test_hidden_pixels_are_those_of_the_stored_mask_where_there_is_one(tmp_path, capsys):
    """Depth is 10 mm off where the mask says that the input camera does not see: by the input image's pixels, some of both."""
    store, _ = make_dataset(tmp_path / "new", targets={"views": ["covisible"]})
    (tmp_path / "depth").mkdir()
    hidden = 0
    for pair in open_dataset(str(store.root)).pairs():
        view = pair.mirror
        off = (view.segment() >= 3) & ~view.covisible()
        hidden += np.count_nonzero(off)
        depth_m = view.depth() / view.depth_units_per_m
        np.save(tmp_path / "depth" / f"{view.pose_id:05d}.npy", depth_m + 0.01 * off)
    _, answer, _ = score(capsys, store.root, tmp_path, "--out", tmp_path / "score")
    value = {name: one["value"] for name, one in answer["metrics"].items()}
    assert (answer["hidden_by"], value["depth_mae_seen_m"], round(value["depth_mae_hidden_m"], 9)) == (
        "rays",
        0.0,
        0.01,
    )
    rows = pq.read_table(tmp_path / "score" / "items.parquet").to_pylist()
    assert sum(row["depth_pixels_hidden"] for row in rows) == hidden > 200
    assert "the stored image covisible" in (tmp_path / "score" / "index.html").read_text()


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


FAULTS = [
    ("depth", ".npy", lambda path: np.save(path, np.load(path) * 1000.0), "millimetres"),
    ("depth", ".npy", lambda path: np.save(path, np.load(path)[:50]), r"\(50, 160\)"),
    ("depth", ".npy", invert_depth, "inverted"),
    ("depth", ".npy", lambda path: cut(path, 500), "cannot be read"),
    ("depth", ".npy", lambda path: np.save(path, np.array([{}], dtype=object), allow_pickle=True), "allow_pickle"),
    ("depth", ".npy", twice, "there 2 times"),
    ("depth", ".npy", lambda path: path.write_bytes(b"\x93NUMPY\x01\x00\x28\x23" + b"(" * 9000), "cannot be read"),
    ("rgb", ".png", lambda path: cut(path, -40), "torn|damaged|cut"),
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
    refused = {(row["kind"], row["pose_id"]): row["reason"] for row in rows if row["status"] in ("refused", "unknown")}
    for key, told in expected.items():
        assert re.search(told, refused.pop(key)), key
    others = {("depth", 90001): "another dataset", ("depth", None): "no pose id", ("pose", None): "line 2 of poses.csv"}
    assert set(refused) == set(others) and all(others[key] in why for key, why in refused.items())
    assert (status, answer["refused"], answer["unknown"]) == (1, len(FAULTS), 3)
    assert answer["missing"] == 1 + PAIRS  # of poses there is none of the dataset
    assert "missing" in said and answer["metrics"]["depth_mae_m"]["value"] > 0.0
    within = answer["metrics"]["depth_within_2mm"]
    assert within["value"] == within["coverage"] == pytest.approx(1 / PAIRS)  # the others count as worst
    assert answer["metrics"]["pose_rotation_deg"]["value"] == 180.0


@pytest.mark.minute
def test_an_item_that_ends_its_process_is_refused_and_the_others_are_scored(
    files, depths, tmp_path, capsys, monkeypatch
):
    deadly, real = min(int(path.stem) for path in (depths / "depth").iterdir()), module._answers

    def answers(ranges, kept):
        for item, answer in real(ranges, kept):
            ends = deadly in item.poses and not item.blame
            yield item, Ended("crashed", "crashes its process (SIGSEGV)") if ends else answer

    monkeypatch.setattr(module, "_answers", answers)
    status, answer, said = score(capsys, files.root, depths, "--out", tmp_path)
    assert (status, answer["items"], answer["refused"], answer["missing"]) == (1, PAIRS, 1, 0)
    assert f"{deadly:05d} refused: scoring it crashes its process (SIGSEGV)" in said
    monkeypatch.setattr(module, "_answers", lambda ranges, kept: ((item, Ended("killed", "killed")) for item in ranges))
    assert main(["score", str(files.root), str(depths), "--out", str(tmp_path)]) == 1
    assert "start again, what is scored is kept" in capsys.readouterr().err


@pytest.mark.minute
def test_two_runs_into_one_folder_and_a_dataset_that_grows_meanwhile_are_told(
    files, depths, tmp_path, capsys, monkeypatch
):
    words = ["score", str(files.root), str(depths), "--out", str(tmp_path / "score")]
    (tmp_path / "score").mkdir()
    with open(tmp_path / "score" / module.KEPT, "ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert main(words) == 1
    assert "another `verso score` writes" in capsys.readouterr().err and len([*(tmp_path / "score").iterdir()]) == 1
    words[1], real = str(shutil.copytree(files.root, tmp_path / "grows")), module._answers
    last = max((tmp_path / "grows" / "manifest" / "_commits").iterdir())
    aside = last.rename(tmp_path / last.name)

    def answers(ranges, kept):
        yield from real(ranges, kept)
        if aside.exists():
            aside.rename(last)

    monkeypatch.setattr(module, "_answers", answers)
    assert main(words) == 1
    assert "(2 scenes before, 4 now): score it again" in capsys.readouterr().err
    assert not (tmp_path / "score" / "items.parquet").exists() and main(words) == 0


@pytest.mark.minute
def test_the_better_of_two_is_told_and_what_was_scored_is_kept(files, truth, tmp_path, capsys):
    near = write_depth(files, tmp_path / "near", lambda depth_m, _: depth_m + 0.001 * (depth_m > 0))
    far = write_depth(files, tmp_path / "far", lambda depth_m, n: depth_m + (0.004 + 0.0001 * n) * (depth_m > 0))
    answers = [score(capsys, files.root, folder)[1] for folder in (near, far)]
    assert answers[0]["metrics"]["depth_mae_m"]["value"] == pytest.approx(0.001, abs=1e-6)
    assert answers[1]["metrics"]["depth_mae_m"]["low"] < 0.00435 < answers[1]["metrics"]["depth_mae_m"]["high"]
    summary = json.loads((far / "score" / "summary.json").read_text())
    assert len(summary["by"]["category"]) > 1
    require_groups_that_add_up(summary)
    scaled = write_depth(files, tmp_path / "scaled", lambda depth_m, _: 3.0 * depth_m)
    answer = score(capsys, files.root, scaled, "--align", "scale")[1]
    assert answer["refused"] == 0 and answer["metrics"]["depth_mae_scene_m"]["value"] < 1e-9
    assert main(["score", str(files.root), "--compare", str(near), str(scaled)]) == 2
    assert "--align none and scale" in capsys.readouterr().err
    metrics = score(capsys, files.root, "--compare", near, far)[1]["metrics"]
    assert metrics["depth_mae_m"]["low"] > 0.0 and metrics["depth_mae_m"]["better"] is None  # of four scenes
    kept = (near / "score" / module.KEPT).stat()
    assert score(capsys, files.root, near)[1] == answers[0]
    assert (near / "score" / module.KEPT).stat() == kept
    first = min((near / "depth").glob("*.npy"))
    time_of_change = first.stat().st_mtime_ns
    np.save(first, np.load(first) + 0.01)
    os.utime(first, ns=(time_of_change, time_of_change))  # as where the clock was set back
    assert score(capsys, files.root, near)[1]["metrics"]["depth_mae_m"]["value"] > 0.002


def require_groups_that_add_up(summary):
    """Each item is in one group of a kind, and their means are the whole's."""
    for groups, name in itertools.product(filter(None, summary["by"].values()), HEADLINES):
        whole = summary["metrics"].get(name, {"items": 0})
        parts = [group[name] for group in groups.values() if whole["items"] and group[name]["items"]]
        assert sum(part["items"] for part in parts) == whole["items"]
        for key in ("value", "coverage", "worst"):
            total = sum(part[key] * part["items"] for part in parts)
            assert not parts or total / whole["items"] == pytest.approx(whole[key])


@pytest.mark.minute
def test_the_numbers_of_the_page_follow_from_the_items_by_the_queries_under_them(
    files, truth, tmp_path, capsys, monkeypatch
):
    folder = shutil.copytree(truth, tmp_path / "part")
    missing, torn, holes, off = sorted((folder / "depth").iterdir())[:4]
    missing.unlink()
    cut(torn, 500)
    np.save(holes, np.load(holes) * (np.arange(160) % 3 > 0))
    np.save(off, np.load(off) + 0.02)
    for path in [*folder.glob("rgb/*")][::3]:
        cut(path, 40)
    assert score(capsys, files.root, folder, "--out", tmp_path / "score")[0] == 1
    monkeypatch.chdir(tmp_path / "score")
    summary, table = json.loads(Path("summary.json").read_text()), pq.read_table("items.parquet")
    seen = pa.array([None, *np.linspace(0.3, 0.9, table.num_rows - 1).round(1)])  # here all objects are seen whole
    table = table.set_column(table.column_names.index("visible_fraction"), "visible_fraction", seen)
    pq.write_table(table, "items.parquet")
    summary |= summarise(table)
    page = page_of(summary, items_of(table), [])
    queries = [html.unescape(text) for text in re.findall(r"<pre><code>(.*?)</code></pre>", page, re.DOTALL)]
    counts, headlines, others, categories, visible = (duckdb.sql(sql).to_arrow_table().to_pylist() for sql in queries)
    assert sum(row["items"] for row in counts if row["status"] == "refused") == summary["refused"] == 4
    whole = {row["metric"]: row for row in headlines + others}
    shown = {name: figure for name, figure in summary["metrics"].items() if figure["items"]}
    assert whole.keys() == shown.keys() and {row["metric"] for row in headlines} == shown.keys() & {*HEADLINES}
    pairs = [(whole[name], figure) for name, figure in shown.items()]
    for kind, rows in {"category": categories, "visible_fraction": visible}.items():
        assert {row["part"] for row in rows} == summary["by"][kind].keys() and len(summary["by"][kind]) > 1
        pairs += [(row, summary["by"][kind][row["part"]][row["metric"]]) for row in rows]
    for row, figure in pairs:
        for key in ("value", "coverage", "worst", "items"):
            assert row[key] == pytest.approx(figure[key], rel=1e-9, abs=1e-9), (row, key)
    rows = [row for row in pq.read_table("items.parquet").to_pylist() if row["kind"] == "depth"]  # and by hand
    errors_m = [row["farthest_m"] if row["depth_mae_m"] is None else row["depth_mae_m"] for row in rows]
    assert [row["status"] for row in rows].count("ok") == PAIRS - 2
    assert whole["depth_mae_m"]["value"] == pytest.approx(np.mean(errors_m)) and 2.0 < np.mean(errors_m) < 5.0
    covered = sum(1.0 - row["depth_holes"] for row in rows if row["status"] == "ok") / PAIRS
    assert whole["depth_mae_m"]["coverage"] == pytest.approx(covered) and 0.6 < covered < 0.75


@pytest.mark.minute
def test_who_does_not_predict_comes_last_and_no_verdict_is_given(files, truth, tmp_path, capsys):
    """One right pixel an image, one item, and none that can be read, beside a full guess that is 30 mm off."""

    def one_pixel(depth_m, number):
        pixel = np.zeros_like(depth_m)
        first = tuple(np.argwhere(depth_m > 0.0)[len(depth_m) // 2])
        pixel[first] = depth_m[first]
        return pixel

    guess = write_depth(
        files, tmp_path / "guess", lambda depth_m, _: depth_m + 0.02 * (np.arange(160) % 4) * (depth_m > 0.0)
    )
    pixel = write_depth(files, tmp_path / "pixel", one_pixel)
    single, torn = (shutil.copytree(truth, tmp_path / name) for name in ("single", "torn"))
    for path in [*single.glob("*/*"), *torn.glob("*/*")]:
        if torn in path.parents:
            path.write_bytes(b"torn")
        elif not path.stem.endswith("00001"):
            path.unlink()
    assert score(capsys, files.root, guess)[0] == 0
    worst = {}
    for folder in (pixel, single, torn):
        status, answer, _ = score(capsys, files.root, folder)
        assert status == 1
        require_groups_that_add_up(json.loads((folder / "score" / "summary.json").read_text()))
        for name, one in score(capsys, files.root, "--compare", folder, guess)[1]["metrics"].items():
            if name.startswith("depth") and name in HEADLINES:
                assert one["better"] is None and one["coverage"] < 0.2
                assert (one["a"] < one["b"]) == is_better_high(name) or one["a"] == one["b"], (folder, name)
        worst = answer["metrics"]
    assert all(worst[name]["value"] == worst[name]["worst"] for name in HEADLINES if name in worst)
    assert worst["depth_mae_m"]["value"] == 8.0 and worst["rgb_ncc"]["value"] == worst["rgb_ncc"]["coverage"] == 0.0


@pytest.mark.minute
def test_a_leaderboard_has_every_run_and_compares_none_that_leaves_something_out(files, truth, tmp_path, capsys):
    near = write_depth(files, tmp_path / "near", lambda depth_m, _: depth_m + 0.001 * (depth_m > 0))
    far = write_depth(files, tmp_path / "far", lambda depth_m, _: depth_m + 0.006 * (depth_m > 0))
    part = write_depth(files, tmp_path / "part")
    min((part / "depth").iterdir()).unlink()
    for folder in (near, far, part):
        score(capsys, files.root, folder)
    status, answer, _ = score(capsys, "merge", files.root, near, far, part, "--out", tmp_path / "board")
    assert (status, answer["runs"]) == (1, ["near", "far", "part"])
    assert {(one["a"], one["b"]) for one in answer["verdicts"]} == {("near", "far")}
    page, latex = ((tmp_path / "board" / f"leaderboard.{kind}").read_text() for kind in ("md", "tex"))
    assert "part is not compared" in page and r"87.5 \%" in latex
    rows = pq.read_table(tmp_path / "board" / "leaderboard.parquet").to_pylist()
    assert {row["run"] for row in rows if row["category"]} == set(answer["runs"])
    assert score(capsys, "merge", files.root, near, far, "--out", tmp_path / "two")[0] == 0
    summary = far / "score" / "summary.json"
    summary.write_text(summary.read_text().replace('"verso_score": 3', '"verso_score": 2'))
    assert main(["score", "merge", str(files.root), str(near), str(far), "--out", str(tmp_path / "old")]) == 2
    assert "rules of another version" in capsys.readouterr().err


def test_who_is_better_in_twenty_scenes_is_told_and_who_is_not_is_not(files, tmp_path, capsys):
    rng = np.random.default_rng(3)

    def items(off_m):
        facts = {"kind": "depth", "region": 0, "status": "ok", "category": "mug", "visible_fraction": 1.0}
        facts |= {"farthest_m": 8.0, "diagonal_m": 0.25, "depth_pixels": 9.0, "depth_holes": 0.0}
        rows = [{**facts, "scene_id": n, "pose_id": 2 * n + 1, "depth_mae_m": float(e)} for n, e in enumerate(off_m)]
        return pa.Table.from_pylist(rows)

    base = rng.uniform(0.01, 0.02, 20)
    tables = {"a": items(base), "b": items(base + 0.001), "c": items(base + 1e-4 * (-1.0) ** np.arange(20))}
    verdicts = compare_all(tables)
    assert {(one["a"], one["b"]): one["better"] for one in verdicts} == {
        ("a", "b"): "a",
        ("a", "c"): None,
        ("b", "c"): "c",
    }
    summaries = {name: summarise(table) for name, table in tables.items()}
    assert "a is better than b" in describe_verdicts(verdicts, summaries)
    for name, table in tables.items():
        folder = tmp_path / name
        folder.mkdir()
        pq.write_table(table, folder / "items.parquet")
        head = {"verso_score": 3, "digest": "d", "dataset": "o", "align": "none", "split": "all", "level": "all"}
        (folder / "summary.json").write_text(json.dumps(head))
    for pair, better, words in (("ab", "a", "a is better"), ("bc", "b", "c is better"), ("ac", None, "not decided")):
        folders = [tmp_path / name for name in pair]
        assert main(["score", str(files.root), "--compare", *map(str, folders), "--json"]) == 0
        *lines, answer = capsys.readouterr().out.splitlines()
        row = json.loads(answer)["metrics"]["depth_mae_m"]
        assert row["better"] == better and row["difference"] == pytest.approx(row["b"] - row["a"])
        assert [line.endswith(words) for line in lines if line.startswith("depth_mae_m ")] == [True]


def test_p_values_are_corrected_as_holm_published():
    for given, corrected in (([0.01, 0.04, 0.03, 0.005], [0.03, 0.06, 0.06, 0.02]), ([0.9, 0.8], [1.0, 1.0]), ([], [])):
        rows = [{"p": p, "better": "a"} for p in [*given, None]]
        decide(rows)
        assert [row["p"] for row in rows] == [*map(pytest.approx, corrected), None]
        assert [row["better"] for row in rows] == [*("a" if p < 0.05 else None for p in corrected), None]


@pytest.mark.minute
def test_predictions_are_checked_without_a_score(files, truth, tmp_path, capsys):
    status, answer, _ = score(capsys, "check", files.root, truth)
    assert (status, answer["items"], answer["missing"]) == (0, 3 * PAIRS, 0)
    spoilt = shutil.copytree(truth, tmp_path / "spoilt")
    first, second, *_ = sorted((spoilt / "depth").iterdir())
    np.save(first, 1e3 * np.load(first))
    np.save(second, 0.0 * np.load(second))
    min((spoilt / "rgb").iterdir()).unlink()
    status, answer, said = score(capsys, "check", files.root, spoilt)
    assert (status, answer["refused"], answer["missing"]) == (1, 1, 1) and "millimetres" in said
    assert main(["score", "check", str(files.root), str(spoilt)]) == 1
    told = capsys.readouterr().out
    assert f"depth   {PAIRS - 1} there, 0 missing, 1 refused, coverage 75 %" in told
    assert {path.name for path in spoilt.iterdir()} == {"depth", "rgb", "shape"}


def test_an_object_of_one_colour_has_no_score_that_the_table_gives_it(files, truth, tmp_path, capsys):
    grey = tmp_path / "grey"
    (grey / "rgb").mkdir(parents=True)
    for pair in open_dataset(str(files.root)).pairs():
        image = pair.mirror.rgb()[..., ::-1].copy()
        image[pair.mirror.segment() >= 3] = 128
        cv2.imwrite(str(grey / "rgb" / f"{pair.mirror.pose_id:05d}.png"), image)
    value = {name: one["value"] for name, one in score(capsys, files.root, grey)[1]["metrics"].items()}
    assert value["rgb_ncc"] == value["rgb_ncc_hidden"] == 0.0
    assert (
        value["rgb_psnr_db"] < value["rgb_psnr_image_db"] - 10.0 and value["rgb_ssim"] < 0.7 < value["rgb_ssim_image"]
    )


@pytest.mark.minute
def test_a_split_is_scored_alone_and_is_proposed_where_nothing_else_is_predicted(files, depths, tmp_path, capsys):
    rows = pq.read_table(score_file(files, depths, tmp_path / "all", capsys)).to_pylist()
    split = max({row["split"] for row in rows} - {"mixed"}, key=[row["split"] for row in rows].count)
    chosen = {row["pose_id"] for row in rows if row["split"] == split}
    assert len(chosen) < PAIRS
    status, answer, said = score(capsys, files.root, depths, "--out", tmp_path / "a", "--split", split)
    assert (status, answer["items"]) == (0, len(chosen)) and f"{PAIRS - len(chosen)} predictions of" in said
    part = shutil.copytree(depths, tmp_path / "part")
    for path in part.glob("*/*"):
        if int(path.stem) not in chosen:
            path.unlink()
    status, answer, said = score(capsys, files.root, part)
    assert (status, answer["missing"]) == (1, PAIRS - len(chosen)) and f"--split {split}" in said
    assert score(capsys, files.root, part, "--split", split)[0] == 0
    assert main(["score", str(files.root), "--compare", str(part), str(tmp_path / "all")]) == 2
    assert f"--split {split} and all" in capsys.readouterr().err


@pytest.mark.minute
def test_poses_are_read_by_the_ids_of_the_export_that_they_answer_or_by_ours(files, tmp_path, capsys):
    assert main(["export", str(files.root), str(tmp_path / "bop"), "--format", "bop"]) == 0
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for path in (tmp_path / "bop").glob("*/*/scene_gt.json"):
        for image, poses in json.loads(path.read_text()).items():
            for pose in poses:
                R, t = (" ".join(map(str, pose[name])) for name in ("cam_R_m2c", "cam_t_m2c"))
                lines.append(f"{int(path.parent.name)},{image},{pose['obj_id']},1.0,{R},{t},-1")
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    theirs.mkdir()
    (theirs / "poses.csv").write_text("\n".join(lines))
    for more in ([], ["--frame", "input"]):
        status, answer, said = score(capsys, files.root, theirs, *more)
        assert (status, answer["missing"]) == (0, 0) and "by the ids of an export" in said
        assert answer["metrics"]["pose_mssd_m"]["value"] < 1e-9
    (theirs / "poses.csv").write_text("\n".join([*lines, lines[-1].replace(lines[-1].split(",")[2], "999", 1)]))
    status, answer, said = score(capsys, files.root, theirs)
    assert (status, answer["unknown"], answer["missing"]) == (1, 1, 0) and "obj_id" in said
    ours.mkdir()
    lines = ["scene_id,im_id,obj_id,R,t"]
    for pair in open_dataset(str(files.root)).pairs():
        T = np.linalg.inv(pair.mirror.T_world_cam) @ pair.T_world[3]
        R, t = (" ".join(map(str, part.ravel())) for part in (T[:3, :3], 1e3 * T[:3, 3]))
        lines.append(f"{pair.scene_id},{pair.mirror.pose_id},3,{R},{t}")
    (ours / "poses.csv").write_text("\n".join(lines))
    status, answer, said = score(capsys, files.root, ours)
    assert (status, answer["missing"]) == (0, 0) and "export" not in said
    assert answer["metrics"]["pose_mssd_m"]["value"] < 1e-9


def test_what_may_be_typed_is_what_is_understood():
    """The command line has words of its own: it starts without what knows them."""
    typed = {names[0]: tuple(settings["choices"]) for names, settings in READ_AS}
    known = {"--split": ("all", *SPLITS), "--level": ("all", *LEVELS), "--frame": FRAMES, "--volume": get_args(Volume)}
    assert typed == known
    with pytest.raises(InputError, match="level 4 is of the split unseen: leave --split test out"):
        Asked((), split="test", level="4")


def score_file(files, folder, out, capsys):
    score(capsys, files.root, folder, "--out", out)
    return out / "items.parquet"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "name the folder of predictions"),
        (["nothing"], "has no predictions"),
        (["others"], r"whose names are like depth/00001, depth/00003, depth/00005"),
        (["--compare", "nothing", "nothing"], "has no score"),
    ],
)
def test_what_cannot_be_scored_is_told(files, words, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nothing").mkdir()
    (tmp_path / "others" / "depth").mkdir(parents=True)
    (tmp_path / "others" / "depth" / "90001.npy").write_bytes(b"")
    assert main(["score", str(files.root), *words]) == 2
    assert told in capsys.readouterr().err

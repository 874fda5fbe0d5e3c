"""The benchmark: truth scores full marks, level 3 is what a sensor stores, rows repeat and fit."""

import csv
import re
from pathlib import Path

import baselines
import guesses
import numpy as np
import pytest
import split_by_distance
import trimesh

from services.dataset.dataset import open_dataset
from services.job.job_file import load_job
from services.job.record import record_job
from services.score.items import LEVELS
from tests.datasets import make_dataset, run_here
from workers.capture.results import open_sources

ROOT = Path(__file__).resolve().parents[3]
JOB = ROOT / "deploy/jobs/benchmark.yaml"

FULL_MARKS = {"depth_auc_50mm", "depth_auc_50mm_hidden", "depth_within_2mm", "depth_within_10mm", "rgb_ncc", "rgb_ssim"}
FULL_MARKS |= {"shape_fscore_2mm", "shape_iou", "volume_iou"}
NONE = {"depth_mae_m", "depth_mae_hidden_m", "depth_holes", "shape_chamfer_l1_m", "pose_add_m", "pose_rotation_deg"}
ROUNDING = 1e-6
"""Of a pose through text and of vertices through a file of 32 bits, degrees or metres."""


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory):
    """Four scenes of the benchmark itself: one to train on, one and two objects to test on, two of categories never seen."""
    folder = tmp_path_factory.mktemp("benchmark")
    return open_dataset(run_here(load_job(JOB, ["first_scene=270", "scenes=4"]), folder, JOB.parent)[0].root)


@pytest.mark.minute
def test_truth_scores_full_marks_at_every_level_of_the_benchmark(benchmark, tmp_path):
    rows = baselines.run("truth", benchmark, tmp_path)
    assert {row["level"] for row in rows} == {*LEVELS}
    for row in rows:
        value = float(row["value"])
        assert row["metric"] in FULL_MARKS | NONE | {"rgb_psnr_db"} and int(row["items"]) > 0
        assert row["metric"] not in FULL_MARKS or value == pytest.approx(1.0, abs=ROUNDING)
        assert row["metric"] not in NONE or value < ROUNDING
    assert {row["metric"] for row in rows} == set(baselines.METRICS)


HALVES = {"scenes": 6, "categories": ["mug", "box"], "assets": {"split": {"train": 0.5, "val": 0.0, "test": 0.5}}}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Single objects in small images, half of them to train on."""
    targets = {"shape": ["volume"], "points": 2000}
    return open_dataset(make_dataset(tmp_path_factory.mktemp("small"), targets=targets, **HALVES)[0].root)


@pytest.mark.minute
def test_level_3_has_the_pixels_that_the_same_job_with_noise_stores(small, tmp_path):
    noise = {"depth_noise": {}, "rgb_noise": {}}
    noisy = open_dataset(make_dataset(tmp_path, sensor=noise, check={"mirror_agreement_mm": 50.0}, **HALVES)[0].root)
    patches = 0
    for pair, stored in zip(small.pairs(), noisy.pairs(), strict=True):
        sensed = baselines.sense_input(pair, small.job).input
        patches += sensed.patch() is not None
        for ours, theirs in ((sensed, stored.input), (sensed.patch(), stored.input.patch())):
            assert ours is theirs is None or np.array_equal(ours.depth(), theirs.depth())
            assert ours is theirs is None or np.array_equal(ours.rgb(), theirs.rgb())
        assert not np.array_equal(sensed.depth(), pair.input.depth())
        assert not np.array_equal(sensed.rgb(), pair.input.rgb())
    assert patches > 0


@pytest.mark.slow
def test_baselines_without_a_network_repeat_and_rank_as_they_must(small, tmp_path):
    names = [name for name in baselines.BASELINES if name not in baselines.NETWORKS]
    rows = [row for name in names for row in baselines.run(name, small, tmp_path / "a")]
    some = ("projected and filled", "nearest training shape")
    again = [row for name in some for row in baselines.run(name, small, tmp_path / "b")]
    for row in (*rows, *again):
        del row["seconds"]
    assert [row for row in rows if row["name"] in some] == again
    value = {(row["name"], row["level"], row["metric"]): float(row["value"]) for row in rows}
    for level in ("1", "3"):
        depth = [value[name, level, "depth_within_2mm"] for name in ("truth", "projected and filled", "projected")]
        assert depth == sorted(depth, reverse=True) and depth[0] == 1.0 > depth[1] > depth[2]
        for name in ("flat plate", "half turn", "symmetry"):  # no guess from the wrong side is better
            assert value[name, level, "depth_auc_50mm"] > value["projected and filled", level, "depth_auc_50mm"]
        assert value["projected", level, "depth_holes"] > 0.1 > value["projected and filled", level, "depth_holes"] == 0
    assert 0.0 < value["nearest training shape", "1", "shape_iou"] < 1.0
    assert value["projected", "3", "depth_within_2mm"] < value["projected", "1", "depth_within_2mm"]
    for pair in small.pairs():
        found = guesses.project_input(pair)
        assert np.array_equal(np.rint(found.depth_m * pair.mirror.depth_units_per_m), pair.projected.depth())
        assert np.array_equal(found.rgb, pair.projected.rgb())


def test_the_page_s_table_is_that_of_its_rows_which_are_of_the_job_as_it_is():
    page = (ROOT / "docs/benchmark.md").read_text()
    with (ROOT / "docs/benchmark.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    assert tuple(reader.fieldnames) == baselines.COLUMNS and {row["name"] for row in rows} >= set(
        baselines.BASELINES
    ) - {"truth"}
    job = load_job(JOB)
    digest = record_job(job, open_sources(job, JOB.parent).digest, JOB.parent).digest[:12]
    assert {row["job"] for row in rows} == {digest}
    for row in rows:
        assert int(row["scenes"]) == job.scenes and row["level"] in LEVELS, row
        assert row["metric"] in baselines.METRICS and float(row["low"]) <= float(row["value"]) <= float(row["high"]), (
            row
        )
    assert baselines.table_of([row for row in rows if row["name"] != "truth"]) in page
    assert digest in page and len(re.findall(r"\b[0-9a-f]{64}\b", page)) == 2


@pytest.mark.minute
def test_no_shapes_of_two_splits_are_alike_and_the_check_measures_it(few, tmp_path, capsys):
    balls = [trimesh.creation.icosphere(4, radius) for radius in (0.1, 0.102)]
    a, b = (split_by_distance.sample(ball.vertices, ball.faces) for ball in balls)
    assert split_by_distance.chamfer_mm(a, b) == pytest.approx(2.0, abs=0.05)  # 0.02 of it from the faces' middles
    places = np.random.default_rng(1).uniform(0.0, 10.0, (60, 2))
    apart_mm = np.linalg.norm(places[:, None] - places, axis=2)
    splits = np.array(split_by_distance.make_split(apart_mm, 1.0, range(60)))
    assert all((splits == name).sum() > 1 for name in split_by_distance.SHARES)
    named = splits != ""
    others = named[:, None] & named & (splits[:, None] != splits)
    assert apart_mm[others].min() >= 1.0 and (apart_mm[~np.eye(60, dtype=bool)] < 1.0).sum() > 20
    table = tmp_path / "nearest.csv"
    assert split_by_distance.check(few.root, 0.0, table) and not split_by_distance.check(few.root, 1000.0, None)
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert (
        rows and {row["split"] for row in rows} == {"test"} and "mm to the nearest of train" in capsys.readouterr().out
    )

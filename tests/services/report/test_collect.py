"""Figures against tables made by hand, where each figure can be counted."""

import math

import pyarrow as pa
import pytest

from schemas.dataset.tables import SCHEMAS
from services.look.collect import collect

SCENES = [
    {"scene_id": 0, "category": "mug", "effects": ["drop", "rgb"], "hover_gap_mm": 0.01,
     "skipped": [{"effect": "glass", "why": "no glass"}]},
    {"scene_id": 1, "category": "mug", "effects": ["drop"], "hover_gap_mm": -0.0,
     "skipped": [{"effect": "glass", "why": "no glass"}, {"effect": "rgb", "why": "off"}]},
    {"scene_id": 3, "category": "box", "effects": ["drop", "rgb"], "hover_gap_mm": 0.001,
     "skipped": [{"effect": "glass", "why": "not asked"}]},
]  # fmt: skip
FILES = [{"bytes": 100, "path": "a", "sha256": "0"}, {"bytes": 50, "path": "b", "sha256": "0"}]
VIEWS = [
    {"role": "input", "visible_fraction": 0.5, "inclination_rad": math.radians(45), "d_z_m": 2.5, "files": FILES},
    {"role": "mirror", "visible_fraction": 1.0, "inclination_rad": math.radians(40), "d_z_m": 2.5, "files": FILES[:1]},
    {"role": "input", "visible_fraction": None, "inclination_rad": math.radians(47), "d_z_m": 2.1, "files": []},
    {"role": "projected", "visible_fraction": None, "inclination_rad": 0.7, "d_z_m": 2.1, "files": FILES},
]
TIMINGS = [
    {"stages": [{"name": "physics", "seconds": 1.5}], "effects": [{"name": "drop", "seconds": 1.0}], "total_s": 2.0},
    {"stages": [{"name": "physics", "seconds": 0.5}, {"name": "render", "seconds": 4.0}], "total_s": 5.0,
     "effects": [{"name": "drop", "seconds": 0.25}]},
]  # fmt: skip
FAILED = {"category": "mug", "kind": "intrinsic", "attempts": 1, "stage": "settle"}
FAILURES = [
    {"scene_id": 2, "reason": "left_table", "detail": "at 0.7 m", **FAILED},
    {"scene_id": 5, "reason": "no_rest", "detail": "moved", **FAILED},
    {"scene_id": 4, "reason": "left_table", "detail": "at 0.8 m", **FAILED},
]
ASSETS = [
    {"instance_id": "a", "category": "mug"},
    {"instance_id": "t", "category": "table"},
    {"instance_id": "a", "category": "mug"},
    {"instance_id": "b", "category": "box"},
]


class Handmade:
    """Tables of rows, in batches of one and of the rest."""

    merged: tuple[str, ...] = ()
    sampled = False

    def __init__(self, **tables) -> None:
        self.tables = tables

    def batches(self, table, columns):
        schema = pa.schema([SCHEMAS[table].field(name).with_nullable(True) for name in columns])
        rows = [{name: row.get(name) for name in columns} for row in self.tables.get(table, [])]
        yield from (pa.Table.from_pylist(part, schema) for part in (rows[:1], rows[1:]) if part)


@pytest.fixture(scope="module")
def figures():
    return collect(Handmade(scenes=SCENES, views=VIEWS, timings=TIMINGS, failures=FAILURES, assets=ASSETS))


def test_totals_are_counted(figures):
    assert (figures.scenes, figures.by_category) == (3, {"box": 1, "mug": 2})
    assert (figures.views, figures.pairs, figures.files, figures.bytes) == (4, 2, 5, 400)
    assert (figures.instances, figures.seconds) == (2, 7.0)
    assert not figures.sampled


def test_an_effect_has_its_runs_its_time_and_the_reasons_for_leaving_it_out(figures):
    drop, rgb, glass = (figures.effects[name] for name in ("drop", "rgb", "glass"))
    assert (drop.runs, drop.seconds, drop.timed, drop.skips) == (3, 1.25, 2, {})
    assert (rgb.runs, rgb.timed, dict(rgb.skips)) == (2, 0, {"off": 1})
    assert (glass.runs, dict(glass.skips)) == (0, {"no glass": 2, "not asked": 1})
    assert next(iter(figures.effects)) == "drop"


def test_a_stage_has_its_time_over_the_scenes_that_had_it(figures):
    physics = figures.stages["physics"]
    assert list(figures.stages) == ["render", "physics"]
    assert (physics.seconds, physics.timed) == (2.0, 2)


def test_histograms_hold_each_view_in_its_role(figures):
    assert figures.visibility["input"].count == 1 and figures.visibility["input"].least == 0.5
    assert figures.visibility["mirror"].most == 1.0
    assert figures.inclination["input"].mean == pytest.approx(46.0)
    assert figures.distance.count == 2 and figures.distance.mean == pytest.approx(2.3)


def test_the_resting_gap_is_counted_by_decades_and_nothing_is_a_nanometre(figures):
    assert (figures.gap.count, figures.gap.least, figures.gap.most) == (3, -6.0, pytest.approx(-2.0))


def test_failures_are_told_once_for_each_reason_with_an_example(figures):
    first, second = figures.failures
    assert (first.reason, first.scenes, first.examples, first.detail) == ("left_table", 2, (2, 4), "at 0.7 m")
    assert (second.reason, second.scenes) == ("no_rest", 1)


def test_a_dataset_without_rows_has_no_figures():
    figures = collect(Handmade())
    assert (figures.scenes, figures.views, figures.failures, figures.captures) == (0, 0, (), ())


def test_captures_have_their_quality():
    capture = {
        "name": "shots/mug", "estimate": "joint", "views": 22, "markers": 35, "reprojection_px": 0.21,
        "left_out": [{"number": 3, "status": "blurred", "why": "x"}], "pose_mm": 0.4, "cloud_median_mm": None,
        "completeness": 0.98, "measured_share": 0.9, "depth_offset_m": 0.0, "depth_scale": 1.0, "print_scale": 1.0,
        "identified": [], "depth_corrected": False, "undistorted": False, "converged": True, "iterations": 3,
        "cloud_points": 7, "notes": [],
    }  # fmt: skip
    scenes = [{"scene_id": 7, "category": "mug", "effects": [], "skipped": [], "capture": capture}]
    (one,) = collect(Handmade(scenes=scenes)).captures
    assert (one.name, one.views, one.left_out, one.pose_mm, one.cloud_median_mm) == ("shots/mug", 22, 1, 0.4, None)
    assert collect(Handmade(scenes=scenes)).gap.count == 0

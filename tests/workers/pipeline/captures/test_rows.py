"""Rows of a capture: quality columns, identity of the object, and what a capture cannot have."""

import dataclasses
from pathlib import Path

import pytest

from schemas.capture import ProcessedCapture
from tests.captures import captures_job, exact_capture
from workers.assets.catalogue import split_of
from workers.capture.make_capture import make_pairs, place_capture
from workers.capture.results import open_sources
from workers.capture.rows import LeftOut, Origin, record_capture
from workers.scene.context import Stopwatch, WorkerContext, open_worker

JOB = captures_job()


@pytest.fixture(scope="module")
def context() -> WorkerContext:
    return open_worker(JOB, open_sources(JOB, Path()))


def rows_of(context: WorkerContext, done: ProcessedCapture, scene_id: int = 0, more: tuple = ()) -> dict[str, list]:
    thing = place_capture(context.job, scene_id, done, "mug", "capture")
    pairs = [*make_pairs(context, thing, done, Stopwatch()), *more]
    return record_capture(context, thing, done, Origin(False, "f" * 64), pairs, Stopwatch()).rows


def test_residuals_before_and_after_are_those_of_the_used_views(context):
    quality = rows_of(context, exact_capture())["scenes"][0]["capture"]
    assert quality["reprojection_before_px"] == pytest.approx(0.515)  # views 1 and 2: 0.51 and 0.52
    assert quality["reprojection_px"] == pytest.approx(0.215)
    assert (quality["markers"], quality["depth_offset_m"], quality["identified"]) == (60, 0.002, ["offset_m"])
    assert quality["measured_share"] == pytest.approx(0.97)


def test_errors_are_those_of_the_score_and_absent_without_truth(context):
    scored, unknown = (
        rows_of(context, dataclasses.replace(exact_capture(), score=s)) for s in (exact_capture().score, None)
    )
    assert scored["scenes"][0]["capture"]["completeness"] == 0.98
    assert unknown["scenes"][0]["capture"]["completeness"] is None
    known = [(row["capture"]["number"], row["role"], row["capture"]["depth_median_mm"]) for row in scored["views"]]
    assert [one for one in known if one[2] is not None] == [(1, "input", 0.5)]
    assert {row["capture"]["pose_mm"] for row in unknown["views"]} == {None}


def test_what_a_mirror_view_is_made_of_is_told_with_it_alone(context):
    views = rows_of(context, exact_capture())["views"]
    told = {row["role"]: (row["capture"]["sources"], row["capture"]["measured_share"]) for row in views}
    assert told == {"input": (None, None), "mirror": ([1, 2], 0.97), "projected": (None, None)}


def test_views_that_are_left_out_are_listed_in_order_and_not_counted(context):
    spare = LeftOut(1, "spare", "captures.most_views is 4")
    quality = rows_of(context, exact_capture(), more=(spare,))["scenes"][0]["capture"]
    assert [(one["number"], one["status"]) for one in quality["left_out"]] == [(0, "flagged"), (1, "spare")]
    assert quality["views"] == 1


def test_captures_of_one_object_are_different_assets_of_one_split(context):
    rows = [row for n in range(6) for row in rows_of(context, exact_capture(), n)["assets"] if row["category"] == "mug"]
    assert len({row["instance_id"] for row in rows}) == 6
    assert {row["split"] for row in rows} == {split_of("mug-0", JOB.assets.split)}
    by_own_name = {split_of(f"mug-0-{n:05d}", JOB.assets.split) for n in range(40)}
    assert len(by_own_name) > 1  # captures of one object would leak

"""Scenes from a job to the table: settled, judged, refused, let go again."""

import dataclasses
import sys
from pathlib import Path

import pytest
import yaml

from schemas.errors import SettleError
from schemas.job.job import Job
from tests.hard_cases.bodies import cube
from tests.hard_cases.groups import stack
from tests.judge import bias, piles, scenes
from tests.judge.hollows import CONTENTS, HOLLOWS, draw_hollow
from tests.judge.judge import Verdict
from tests.judge.piles import try_pile
from tests.judge.scenes import Asked, Outcome, try_scene
from tests.judge.table import describe, is_within, summary, tabulate
from tests.physics.settling import PHYSICS, scene_of

GOOD = Outcome(0, 8, 1.0, {"release": 0.75}, verdicts=[Verdict(0.004, 0.0, 0.0), Verdict(0.0, 0.006, 0.001)])
REFUSED = Outcome(1, 8, 3.0, {"release": 2.0}, "unsupported", "leaves 3 %")
LEFT = Outcome(2, 8, 2.0, {}, "left_table", "gone")


def test_a_scene_is_settled_judged_and_let_go_again():
    group = stack(cube(0.05))
    one = try_scene(7, scene_of(group.starts, group.table), PHYSICS, Asked(recheck=True))
    assert (one.scene_id, one.objects, one.refused) == (7, 1, "")
    assert is_within(one) and one.worst.overlap_mm < 1e-4 and one.worst.unbalanced < 1e-6
    assert one.stored is not None and one.moved_mm is not None and one.moved_mm < 0.1
    assert 0.0 < one.parts_s["release"] < one.seconds


RAISED = [(SettleError("left_table", "gone"), "left_table"), (ZeroDivisionError(), "crashed")]


@pytest.mark.parametrize(("error", "reason"), RAISED)
def test_what_physics_raises_is_told(monkeypatch, error, reason):
    def raises(*_):
        raise error

    monkeypatch.setattr(scenes, "settle_scene", raises)
    group = stack(cube(0.05))
    one = try_scene(0, scene_of(group.starts, group.table), PHYSICS, Asked())
    assert one.refused == reason and one.detail


def test_the_worst_of_objects_and_of_scenes_is_told_and_the_accepted_share_is_of_those_that_stayed():
    found = summary([GOOD, REFUSED, LEFT])
    assert found["worst"] == {"overlap_mm": 0.004, "hover_mm": 0.006, "unbalanced": 0.001}
    assert (found["scenes"], found["left_table"], found["refused"], found["accepted"]) == (
        3,
        1,
        {"unsupported": 1},
        0.5,
    )
    assert found["physics_s"] == [2.0, 2.0, 3.0] and found["parts_s"]["release"] == pytest.approx([0.75, 2.75 / 3, 2.0])
    assert (found["over_0.01_mm"], found["over_1_percent"]) == (0, 0)
    row = tabulate("set", [GOOD, REFUSED, LEFT]).splitlines()
    assert {line.count("|") for line in row[:3]} == {15} and "1 unsupported" in row[2] and "50.0%" in row[2]


@pytest.mark.parametrize(
    "changes",
    [
        {"verdicts": [Verdict(0.011, 0.0, 0.0)]},
        {"verdicts": [Verdict(0.0, 0.011, 0.0)]},
        {"verdicts": [Verdict(0.0, 0.0, 0.011)]},
        {"moved_mm": 0.11},
        {"turned_deg": 0.11},
    ],
)
def test_each_bound_is_held(changes):
    assert is_within(GOOD) and is_within(REFUSED)
    assert not is_within(dataclasses.replace(GOOD, **changes))


def test_a_scene_is_described_by_its_reason_or_its_worst_figures():
    assert "refused after 3.00 s: unsupported: leaves 3 %" in describe(REFUSED)
    assert "overlap 0.00400 mm, hover 0.00600 mm, unbalanced 0.10%" in describe(GOOD)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2024, 7])
@pytest.mark.parametrize(("objects", "kind", "count"), [(8, "table", 20), (15, "table", 10), (25, "bin", 5)])
def test_heaps_rest_through_the_gate_and_the_judge(objects, kind, count, seed):
    """All but one: a heap is chaotic, and another processor makes others. Docs/rest.md has the shares of more scenes."""
    document = yaml.safe_load(Path("deploy/jobs/pile.yaml").read_text())
    tables = [{"source": "procedural", "kind": kind}]
    document["assets"]["tables"], document["objects_per_scene"], document["seed"] = tables, objects, seed
    document.pop("verso")
    found = [try_pile(Job.model_validate(document), Asked(), scene_id) for scene_id in range(count)]
    assert sum(bool(one.refused) for one in found) <= 1
    assert all(is_within(one) for one in found if not one.refused)


def test_every_kind_is_dropped_into_every_hollow_the_same_way_each_time():
    job = Job(name="t")
    plans = [draw_hollow(job, k) for k in range(len(HOLLOWS) * len(CONTENTS))]
    pairs = {(plan.objects[0].asset.sha256, plan.objects[1].asset.sha256) for plan in plans}
    assert len(pairs) == len(HOLLOWS) * len(CONTENTS)
    assert all(plan.objects[0].asset.watertight and plan.objects[1].asset.lofted is None for plan in plans)
    assert (draw_hollow(job, 3).objects[1].T_world_obj == plans[3].objects[1].T_world_obj).all()
    rims = [plan.objects[0].asset.extents_m[2] for plan in plans]
    assert all(
        plan.objects[1].T_world_obj[2, 3] > plan.table.top.height_m + rim for plan, rim in zip(plans, rims, strict=True)
    )


def test_the_command_prints_the_table_and_writes_every_scene(tmp_path, monkeypatch, capsys):
    document = {"verso": 1, "name": "two", "categories": ["can"], "start": {"pose": "upright"}}
    (tmp_path / "job.yaml").write_text(yaml.safe_dump(document))
    words = [
        "--job",
        str(tmp_path / "job.yaml"),
        "--scenes",
        "2",
        "--objects",
        "1",
        "--json",
        str(tmp_path / "out.json"),
    ]
    monkeypatch.setattr(sys, "argv", ["piles", *words])
    assert piles.main() == 0
    assert "| two, 1 objects | 2 | 0 | none | 100.0% |" in capsys.readouterr().out
    written = yaml.safe_load((tmp_path / "out.json").read_text())
    assert [one["scene_id"] for one in written["scenes"]] == [0, 1] and written["summary"]["accepted"] == 1.0


def test_the_table_of_bias_counts_classes_heights_and_what_is_lost():
    def some(tilts, heights, lost=()):
        return [bias.Lying(k // 2, k in lost, t, h) for k, (t, h) in enumerate(zip(tilts, heights, strict=True))]

    both = bias.Both(
        some((0, 180, 90, 10), (10, 20, 30, 40), lost=(3,)), some((0, 0, 90, 90), (5, 5, 5, 1e6), lost=(3,))
    )
    table = [line.split("|") for line in bias.tabulate("pile", [both, bias.Both([], [])]).splitlines()]
    assert table[0] == ["pile: 2 scenes, 1 refused"]
    figures = [[float(cell.split()[0]) for cell in row[2:-1]] for row in table[2:]]
    assert figures == [
        [3, 25, 66.7, 0, 33.3, 5],
        [4, 25, 50, 25, 25, 25],
        [3, 25, 33.3, 33.3, 33.3, 20],
    ]

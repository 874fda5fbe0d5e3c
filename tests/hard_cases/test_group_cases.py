"""Every hard case with several objects, twice: its declared outcome, its bounds, and the same bits; and once more let go."""

import dataclasses
import functools
import math
import re
from collections.abc import Sequence
from typing import Any

import pytest

from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.scene.scene import Settled
from tests.hard_cases.case import EITHER
from tests.hard_cases.group_cases import GROUPS, GroupCase
from tests.hard_cases.group_measures import worst_gap_mm
from tests.hard_cases.groups import Group
from tests.hard_cases.test_hard_cases import GAP_MM, MOVED_MM, TURNED_DEG
from tests.physics.settling import effects_of, settle_group
from workers.physics.placement import Ground
from workers.physics.release import Drop, release
from workers.physics.settle import UNBALANCED
from workers.physics.step import moved_by

PHYSICS = Job(name="t").physics
FINEST, WATCHED_S = 16, 1.0


@functools.cache
def asked_for(case: GroupCase) -> Group:
    return case.make()


def ending(case: GroupCase) -> tuple[Settled, ...] | SceneError:
    """What production comes to: every rest pose, or why there is none."""
    group = asked_for(case)
    try:
        return settle_group(group.starts, group.table, PHYSICS)
    except SceneError as error:
        return error


first_ending = functools.cache(ending)


def bits(end: tuple[Settled, ...] | SceneError) -> object:
    """All of an ending, for comparing to the last bit."""
    if isinstance(end, SceneError):
        return str(end)
    return [(each.T_world_obj.tobytes(), each.settle_s, each.equilibrium_residual, each.support) for each in end]


def judge(case: GroupCase, end: tuple[Settled, ...] | SceneError) -> tuple[float | None, str]:
    """(figure, what is wrong or '')."""
    if isinstance(end, SceneError):
        away = re.search(r"was at \((\S+), (\S+), (\S+)\) m", end.detail)
        far = math.hypot(*map(float, away.groups()[:2])) * 1e3 if away else 0.0
        wrong = "" if case.outcome == EITHER and far <= case.measure.bound else str(end)
        return far, wrong
    group = asked_for(case)
    figure, gap, unbalanced = (
        case.measure.of(group, end),
        worst_gap_mm(group, end),
        max(each.equilibrium_residual for each in end),
    )
    wrong = "" if gap <= GAP_MM else f"{gap:.3f} mm of penetration or gap"
    wrong = wrong or ("" if unbalanced <= UNBALANCED else f"{unbalanced:.0%} of a weight has nothing to rest on")
    return figure, wrong or ("" if figure <= case.measure.bound else f"{figure:.4g} of {case.measure.bound:g}")


def let_go_again(case: GroupCase, rest: Sequence[Settled]) -> tuple[float, float]:
    """The most that any object moves, mm, and turns, degrees, in a second of the finest steps."""
    group = asked_for(case)
    still = PHYSICS.rest.model_copy(update={"window_s": 2 * WATCHED_S})  # so that nothing counts as resting before
    fine = {"step_hz": FINEST * PHYSICS.step_hz, "max_settle_s": WATCHED_S, "rest": still}
    settings, effects = PHYSICS.model_copy(update=fine), effects_of(group.starts, group.table, PHYSICS)
    poses = [each.T_world_obj for each in rest]
    flat = rest[0].support == "flat_top"
    starts = tuple(dataclasses.replace(start, T_world_obj=T) for start, T in zip(group.starts, poses, strict=True))
    after = release(Drop(starts, Ground(group.table), settings, effects), flat)
    assert after.seconds >= WATCHED_S
    moved = [moved_by(*each) for each in zip(group.starts, poses, after.poses, strict=True)]
    return max(mm for mm, _ in moved), max(deg for _, deg in moved)


def rows(moves: bool) -> list[Any]:
    """The cases, those that are expected to fail marked so; what takes long to let go again is left to `--ci` or `--all`."""
    found = []
    for case in GROUPS:
        why = case.moves if moves else case.miss
        marks = [pytest.mark.xfail(reason=why, raises=AssertionError)] if why else []
        if moves:
            marks += [pytest.mark.slow] * case.slow + [pytest.mark.minute] * case.minute
        found.append(pytest.param(case, id=case.name, marks=marks))
    return found


@pytest.mark.parametrize("case", rows(moves=False))
def test_a_hard_case_with_several_objects_ends_as_declared_and_twice_alike(case, record_figure):
    end = first_ending(case)
    figure, wrong = judge(case, end)
    outcome = f"known miss of {case.outcome}" if case.miss else case.outcome
    record_figure(f"{case.name}: {case.measure.what}", outcome, figure, case.measure.bound)
    assert not wrong
    assert bits(end) == bits(ending(case))


@pytest.mark.parametrize("case", rows(moves=True))
def test_several_objects_at_rest_stay_where_they_are_when_they_are_let_go_again(case, record_figure):
    end = first_ending(case)
    if isinstance(end, SceneError):
        assert case.outcome == EITHER
        return
    mm, degrees = let_go_again(case, end)
    outcome = f"known miss of {case.outcome}" if case.moves else case.outcome
    record_figure(f"{case.name}: moved when let go again, mm", outcome, mm, MOVED_MM)
    record_figure(f"{case.name}: turned when let go again, deg", outcome, degrees, TURNED_DEG)
    assert mm <= MOVED_MM and degrees <= TURNED_DEG


def test_no_two_cases_with_several_objects_have_one_name():
    assert len({case.name for case in GROUPS}) == len(GROUPS)

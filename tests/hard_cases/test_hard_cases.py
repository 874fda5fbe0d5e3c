"""Every hard case, twice: its declared outcome, its bounds, the gate, and the same bits; and once more let go."""

import functools
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import Settled
from tests.hard_cases.camera_cases import CAMERAS
from tests.hard_cases.case import EITHER, FALL, SETTLE, UNDEFINED, Case, Made, nudged
from tests.hard_cases.cases import CASES
from tests.hard_cases.chaotic_cases import SEEDS
from tests.hard_cases.gate import verdicts, what_is_wrong
from tests.hard_cases.spin import spinning
from tests.physics.settling import recheck_group, settle_group

PHYSICS = Job(name="t").physics

MOVED_MM, TURNED_DEG = 0.1, 0.1
"""The most by which what rests moves in a second after it is let go again."""

FALLEN_MM = -50.0
"""What has left the table ends lower than this against the table's top, by its centre of mass."""

End = tuple[Settled, ...] | SceneError


def physics_of(case: Case) -> Physics:
    return PHYSICS.model_copy(update=case.physics)


def ending(case: Case, move: Callable[[Made], Made] = lambda made: made) -> tuple[Made | None, End]:
    """What a case comes to: the objects, as moved before they are let go, and their rest poses, or why there are none."""
    made = None
    try:
        made = move(case.make())
        with spinning(case.spin):
            return made, settle_group(made.starts, made.table, physics_of(case))
    except SceneError as error:
        return made, error


first_ending = functools.cache(ending)


def bits(end: End) -> object:
    """All of an ending, for comparing to the last bit."""
    if isinstance(end, SceneError):
        return end.reason, re.sub(r"\S*/", "", end.detail)  # without the temporary folder that a file was in
    return [(each.T_world_obj.tobytes(), np.array(figures_of(each)).tobytes(), each.support) for each in end]


def figures_of(rest: Settled) -> tuple[float, ...]:
    """What is stored of a rest beside its pose."""
    return (
        rest.penetration_mm,
        rest.hover_gap_mm,
        rest.support_margin_mm,
        rest.residual_speed_mm_s,
        rest.equilibrium_residual,
        rest.settle_s,
    )


def fallen_mm(made: Made, error: SceneError) -> float:
    """Height of the centre of mass against the table's top, from the message: mm."""
    height = re.search(r"was at \(\S+, \S+, (\S+)\) m", error.detail)
    assert height is not None, error
    return (float(height[1]) - made.table.top.height_m) * 1e3


def judge(case: Case, made: Made | None, end: End) -> tuple[str, float | None, float | None, str]:
    """(what is measured, figure, bound, what is wrong or '')."""
    if not isinstance(end, SceneError):
        assert made is not None
        if case.measure is None:
            return "outcome", None, None, "it settled"
        figure = float(case.measure.of(made, end))
        wrong = what_is_wrong(verdicts(made, end, physics_of(case)))
        if figure > case.measure.bound:
            wrong = f"{case.measure.what}: {figure:.4g} where {case.measure.bound:g} is the bound; {wrong}"
        return case.measure.what, figure, case.measure.bound, wrong
    if end.reason == "left_table" and case.outcome in (FALL, EITHER, UNDEFINED):
        assert made is not None
        height = fallen_mm(made, end)
        wrong = "" if height <= FALLEN_MM else f"only at {height:.0f} mm"
        return "height at the end, mm", height, FALLEN_MM, wrong
    allowed = case.outcome in (UNDEFINED, f"must refuse: {end.reason}")
    return "reason", None, None, "" if allowed else str(end)


def rows(cases: Sequence[Case], again: bool) -> list[Any]:
    """The cases, with the markers of their time; made again, all but every eighth run with --all."""
    found = []
    for number, case in enumerate(cases):
        tiers = {case.tier, case.again, "slow" if number % 8 else ""} if again else {case.tier}
        marks = [getattr(pytest.mark, name) for name in sorted(tiers - {""})]
        found.append(pytest.param(case, id=case.name, marks=marks))
    return found


@pytest.mark.parametrize("case", rows(CASES, again=False))
def test_a_hard_case_ends_as_declared(case, record_figure):
    what, figure, bound, wrong = judge(case, *first_ending(case))
    record_figure(f"{case.name}: {what}", case.outcome, figure, bound)
    assert not wrong


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("case", rows([case for case in CASES if not case.tier], again=False))
def test_a_hard_case_ends_as_declared_however_it_is_moved_by_micrometres_at_release(case):
    wrong = {seed: judge(case, *ending(case, functools.partial(nudged, seed=seed)))[-1] for seed in range(1, SEEDS)}
    assert not any(wrong.values()), wrong


@pytest.mark.parametrize("case", rows(CASES, again=True))
def test_a_hard_case_ends_alike_to_the_last_bit_when_it_is_made_again(case):
    assert bits(first_ending(case)[1]) == bits(ending(case)[1])


@pytest.mark.parametrize(
    "case", rows([case for case in CASES if case.outcome in (SETTLE, EITHER, UNDEFINED)], again=True)
)
def test_what_rests_stays_where_it_is_when_it_is_let_go_again(case, record_figure):
    made, end = first_ending(case)
    if isinstance(end, SceneError):
        assert case.outcome in (EITHER, UNDEFINED)
        return
    assert made is not None
    motions = recheck_group(made.starts, end, made.table, physics_of(case))
    mm, degrees = max(one for one, _ in motions), max(one for _, one in motions)
    record_figure(f"{case.name}: moved when let go again, mm", case.outcome, mm, MOVED_MM)
    record_figure(f"{case.name}: turned when let go again, deg", case.outcome, degrees, TURNED_DEG)
    assert mm <= MOVED_MM and degrees <= TURNED_DEG


def test_most_cases_must_settle_or_must_fall_and_no_two_have_one_name():
    definite = sum(case.outcome in (SETTLE, FALL) for case in CASES)
    assert definite >= 0.7 * (len(CASES) + len(CAMERAS))
    assert len({case.name for case in CASES}) == len(CASES)
    assert len(CASES) >= 160 - len(CAMERAS)


def test_whatever_may_settle_has_a_pose_that_it_must_have():
    assert [
        case.name for case in CASES if (case.measure is None) != (case.outcome == FALL or "refuse:" in case.outcome)
    ] == []

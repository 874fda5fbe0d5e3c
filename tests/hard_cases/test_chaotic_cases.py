"""Every chaotic case over its seeds: the share that must rest, the gate for all that do, and how they lie."""

import functools
from typing import Any

import pytest

from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import Settled
from tests.hard_cases.case import Made
from tests.hard_cases.chaotic_cases import CHAOTIC, FIRST, SEEDS, Chaotic
from tests.hard_cases.gate import verdicts, what_is_wrong
from tests.hard_cases.spin import spinning
from tests.hard_cases.test_hard_cases import MOVED_MM, TURNED_DEG
from tests.physics.settling import recheck_group, settle_group
from workers.physics.hold import HELD

PHYSICS = Job(name="t").physics
MAY_HAPPEN = ("left_table", "not_at_rest")
"""Reasons for which a seed may have no rest; and of a heap, which is held for longer, that something slips."""


@functools.cache
def ending(case: Chaotic, seed: int) -> tuple[Made, tuple[Settled, ...] | SceneError]:
    made = case.make(seed)
    try:
        with spinning(case.spin):
            return made, settle_group(made.starts, made.table, PHYSICS.model_copy(update=case.physics))
    except SceneError as error:
        return made, error


def wrong_with(case: Chaotic, seed: int) -> str:
    """What the gate, the pose or a second release says against this seed; empty if nothing, or if it does not rest."""
    made, end = ending(case, seed)
    physics = PHYSICS.model_copy(update=case.physics)
    if isinstance(end, SceneError):
        slips = len(made.starts) >= HELD[0][0] and "slips" in str(end)
        return "" if slips or end.reason in (*MAY_HAPPEN, case.refused) else str(end)
    found = what_is_wrong(verdicts(made, end, physics))
    if (figure := case.measure.of(made, end)) > case.measure.bound:
        found = f"{case.measure.what}: {figure:.4g} of {case.measure.bound:g}; {found}"
    return "; ".join(filter(None, (found, moves(made, end, physics) if case.again else "")))


def moves(made: Made, end: tuple[Settled, ...], physics: Physics) -> str:
    """How far something moves when all are let go again; empty within the bounds."""
    motions = recheck_group(made.starts, end, made.table, physics)
    mm, degrees = max(one for one, _ in motions), max(one for _, one in motions)
    return f"moves by {mm:.3f} mm and {degrees:.3f} degrees" if mm > MOVED_MM or degrees > TURNED_DEG else ""


def rows(tiers: str) -> list[Any]:
    """The cases with the marker of their first seeds or of all."""
    found = []
    for case in CHAOTIC:
        names = {getattr(case, tiers)} - {""}
        marks = [getattr(pytest.mark, name) for name in names]
        found.append(pytest.param(case, id=case.name, marks=marks))
    return found


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("case", rows("first"))
def test_the_first_seeds_rest_through_the_gate(case):
    found = {seed: wrong_with(case, seed) for seed in range(FIRST)}
    assert {seed: wrong for seed, wrong in found.items() if wrong} == {}


@pytest.mark.timeout(7200)
@pytest.mark.parametrize("case", rows("tier"))
def test_the_share_of_seeds_that_rest_is_as_declared_and_all_of_them_pass_the_gate(case, record_figure):
    ends = {seed: ending(case, seed) for seed in range(SEEDS)}
    rested = {seed: (made, end) for seed, (made, end) in ends.items() if not isinstance(end, SceneError)}
    record_figure(f"{case.name}: share of {SEEDS} seeds that rests", "passed", len(rested) / SEEDS, case.rests)
    wrong = {seed: said for seed in ends if (said := wrong_with(case, seed))}
    record_figure(f"{case.name}: seeds that rest and should not", "passed", len(wrong), 0.0)
    assert wrong == {}
    assert len(rested) >= case.rests * SEEDS
    if case.counted is not None:
        counted = sum(case.counted.of(*one) <= case.counted.bound for one in rested.values())
        record_figure(f"{case.name}: share with {case.counted.what}", "passed", counted / len(rested), case.share[0])
        assert case.share[0] <= counted / len(rested) <= case.share[1]


def test_every_chaotic_case_has_at_least_twenty_seeds_and_a_name_of_its_own():
    assert SEEDS >= 20
    assert len({case.name for case in CHAOTIC}) == len(CHAOTIC)

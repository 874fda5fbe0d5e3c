"""The limits on either side of which cases are declared, by statics: on paper, by linear programs, by volumes."""

import itertools
import math

import pytest

from schemas.scene.scene import ObjectStart
from tests.hard_cases.arch_cases import THICK_M, THIN_M, thrust_fits
from tests.hard_cases.balance_cases import BALANCE, hook_demand
from tests.hard_cases.case import SETTLE, Case
from tests.hard_cases.cases import SEVERAL
from tests.hard_cases.hollow_cases import solid
from tests.hard_cases.leaning_cases import (
    CUBE_DEG,
    HOUSE_LOW_DEG,
    HOUSE_STEEP_DEG,
    LADDER_M,
    LOW_DEG,
    MU,
    STEEP_DEG,
    THIN_DEG,
    demand,
    on_a_wall,
)
from tests.hard_cases.measures import coms
from tests.hard_cases.stack_cases import BRICK_M, stairs
from workers.geometry.frames import transform


def wall_needs(size_m: tuple[float, float], angle_deg: float) -> float:
    """Share of the floor's friction that a leaning board needs where the wall gives all of its own, by its two equations."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    inside = (size_m[0] * c - size_m[1] * s) / 2
    wall = inside / (size_m[0] * (s + MU * c))
    return wall / (1.0 - MU * wall) / MU


def test_what_leans_on_a_wall_is_declared_on_the_right_side_of_what_friction_gives():
    assert wall_needs((0.05, 0.05), 20.0) == pytest.approx(0.93, abs=0.005)  # what the table once called at rest
    for size, limit, aside in (((0.05, 0.05), CUBE_DEG, 4.0), (LADDER_M, THIN_DEG, 8.0)):
        assert wall_needs(size, limit) == pytest.approx(1.0)
        assert wall_needs(size, limit + aside) < 0.85
        assert wall_needs(size, limit - aside) > 1.15


def test_what_leans_on_a_wall_begins_beside_it_and_not_in_it():
    for size, angle in (((0.05, 0.05), CUBE_DEG + 4.0), (LADDER_M, THIN_DEG - 8.0)):
        case = on_a_wall(size, angle)
        points = transform(case.start.T_world_obj, case.start.asset.shape.vertices)
        assert 0.15 - points[:, 0].max() == pytest.approx(1e-4, abs=1e-9)
        assert points[:, 2].min() - case.table.top.height_m == pytest.approx(1e-4, abs=1e-9)


def test_cards_that_lean_on_one_another_are_declared_on_the_right_side_of_what_friction_gives():
    assert demand(STEEP_DEG) < 0.7 * MU and demand(HOUSE_STEEP_DEG, 0.25) < 0.7 * MU
    assert demand(LOW_DEG) > 1.4 * MU and demand(HOUSE_LOW_DEG, 0.25) > 1.4 * MU


def test_a_line_of_thrust_fits_into_the_arch_that_must_stand_and_into_no_arch_as_thin_as_the_other():
    assert thrust_fits(7, 0.5 * THICK_M, 0.8 * MU)
    assert not thrust_fits(7, 1.4 * THIN_M, 100.0)
    # Heyman: 0.107 of the mean radius, for joints everywhere.
    assert not thrust_fits(31, 0.0105, 100.0) and thrust_fits(31, 0.0110, 100.0)


@pytest.mark.parametrize(("share", "stands"), [(0.95, True), (1.05, False)])
def test_bricks_over_one_another_balance_on_every_edge_or_on_none(share, stands):
    x = coms(stairs(share))[:, 0]
    margins = [x[k] + BRICK_M[0] / 2 - x[k + 1 :].mean() for k in range(3)]
    assert all((margin > 0.002) == stands and (margin < -0.002) != stands for margin in margins)


def test_hooks_need_less_friction_than_there_is_or_more():
    assert hook_demand(0.1, 0.02) == 0.0
    assert hook_demand(0.03, 0.02) < 0.4 * MU
    assert hook_demand(0.03, 0.06) == math.inf
    assert len(BALANCE) == len({case.name for case in BALANCE})


def volume_shared(a: ObjectStart, b: ObjectStart) -> float:
    """m^3 that two objects at release have in common, as a share of the smaller."""
    bodies = [solid(transform(one.T_world_obj, one.asset.shape.vertices), one.asset.shape.faces) for one in (a, b)]
    return float((bodies[0] ^ bodies[1]).volume() / min(body.volume() for body in bodies))


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.name) for case in SEVERAL if case.outcome == SETTLE and not case.tier]
)
def test_nothing_that_must_settle_begins_inside_of_something_else(case: Case):
    pairs = itertools.combinations(case.make().starts, 2)
    assert max((volume_shared(a, b) for a, b in pairs), default=0.0) < 1e-4

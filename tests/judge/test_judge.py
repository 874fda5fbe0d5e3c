"""The judge against closed forms: slopes, overhangs, ladders, arches, balls, and overlaps and gaps of known depth."""

import math

import numpy as np
import pytest

from schemas.scene.shape import Mesh
from tests.judge.judge import Thing, judge
from tests.judge.solids import ball, bowl, box, funnel, moved, prism, rotation

FLOOR = box((1.0, 1.0, 0.1), (0.0, 0.0, -0.05))
FRICTION = 0.25


def thing(mesh: Mesh, com: tuple[float, ...] | None = None, mass_kg: float = 1.0) -> Thing:
    return Thing(mesh, mass_kg, mesh.vertices.mean(axis=0) if com is None else np.array(com))


def tilted(mesh: Mesh, degrees: float) -> Mesh:
    return moved(mesh, rotation((0.0, 1.0, 0.0), degrees))


@pytest.mark.parametrize("gap_um", [0.1, 1.0, 10.0, 100.0])
@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (1.0, -1.0, 1.0)])
def test_a_gap_above_the_ground_is_measured_to_the_nanometre(gap_um, where):
    things = [box((0.1, 0.1, 0.1), (0.0, 0.0, 0.05 + gap_um * 1e-6)), ball(0.05, (0.2, 0.0, 0.05 + gap_um * 1e-6))]
    found = judge([thing(moved(each, at=where)) for each in things], moved(FLOOR, at=where), FRICTION)
    assert [each.hover_mm for each in found] == pytest.approx([gap_um * 1e-3] * 2, abs=1e-6)
    assert [each.overlap_mm for each in found] == [0.0, 0.0]


@pytest.mark.parametrize("deep_um", [0.1, 5.0, 100.0])
@pytest.mark.parametrize("degrees", [0.0, 37.0])
@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (1.0, -1.0, 1.0)])
def test_two_boxes_are_as_deep_in_one_another_as_they_were_put(deep_um, degrees, where):
    pair = [box((0.1, 0.1, 0.1)), box((0.06, 0.04, 0.1), (0.01, 0.02, 0.1 - deep_um * 1e-6))]
    below = moved(FLOOR, at=(0.0, 0.0, -1.0))
    found = judge([thing(moved(each, rotation((1.0, 2.0, 3.0), degrees), where)) for each in pair], below, FRICTION)
    assert [each.overlap_mm for each in found] == pytest.approx([deep_um * 1e-3] * 2, abs=1e-6)
    assert [each.hover_mm for each in found] == [0.0, 0.0]


def test_crossing_edges_are_as_deep_as_the_planes_along_both_are_apart():
    """Two ridges of 90 degrees at right angles: the intersection is a tetrahedron whose edges across are the two ridges'."""
    deep = 2e-5
    lower = moved(prism([(-0.1, -0.1), (0.1, -0.1), (0.0, 0.0)], 0.2), rotation((0.0, 0.0, 1.0), 90.0))
    upper = prism([(0.0, -deep), (0.1, 0.1 - deep), (-0.1, 0.1 - deep)], 0.2)
    found = judge([thing(lower), thing(upper)], moved(FLOOR, at=(0.0, 0.0, -1.0)), FRICTION)
    assert found[0].overlap_mm == pytest.approx(deep * 1e3, rel=1e-6)


def test_a_ball_in_a_bowl_is_as_deep_in_its_wall_as_it_was_put():
    """A corner of the ball is below the bottom of the bowl, which is a level polygon."""
    radius, deep, at = 0.03, 5e-6, (1.0, 1.0, 0.0)
    dish = moved(bowl(0.06, 0.005), at=at)
    bottom = 0.005 + at[2]
    one = ball(radius, (*at[:2], bottom + radius - deep))
    found = judge([thing(one), thing(dish)], FLOOR, FRICTION)
    assert found[0].overlap_mm == pytest.approx(deep * 1e3, abs=1e-6)
    assert found[1].hover_mm == 0.0


def test_a_bent_sheet_of_overlap_is_as_deep_as_it_is_thick():
    """Two funnels, one lowered into the other: along a whole cone the outer faces of one are inside those of the other."""
    lower, upper, deep = funnel(0.06, 0.004), funnel(0.06, 0.004), 3e-6
    drop = 0.004 - deep  # along z the wall is as thick as it is wide
    slope = math.atan(1.0 / math.cos(math.pi / 64))  # of a flat side
    found = judge([thing(lower), thing(moved(upper, at=(0.0, 0.0, drop)))], moved(FLOOR, at=(0.0, 0.0, -1.0)), FRICTION)
    assert found[0].overlap_mm == pytest.approx(deep * math.cos(slope) * 1e3, rel=1e-3)


@pytest.mark.parametrize(("below_deg", "held"), [(0.1, True), (-0.1, False)])
def test_a_box_stays_on_a_slope_up_to_the_angle_of_friction(below_deg, held):
    angle = math.degrees(math.atan(FRICTION)) - below_deg
    slope, one = tilted(FLOOR, angle), tilted(box((0.1, 0.1, 0.02), (0.0, 0.0, 0.01)), angle)
    (found,) = judge([thing(one)], slope, FRICTION)
    lacking = math.sin(math.radians(angle)) - FRICTION * math.cos(math.radians(angle))
    assert (found.unbalanced < 1e-4) == held
    assert held or found.unbalanced >= lacking * 0.9


@pytest.mark.parametrize(("inside_mm", "held"), [(1.0, True), (-1.0, False)])
def test_an_overhanging_box_stays_while_its_centre_of_mass_is_over_the_edge(inside_mm, held):
    """Where it is outside by d the moment d of the weight is left, a share d / size; a smaller force leaves less of it."""
    one = box((0.2, 0.1, 0.05), (0.5 - inside_mm * 1e-3, 0.0, 0.025))
    (found,) = judge([thing(one)], FLOOR, FRICTION)
    assert (found.unbalanced == pytest.approx(0.0, abs=1e-6)) == held
    lacking = 1e-3 / 0.2
    assert held or lacking * 0.9 <= found.unbalanced <= lacking

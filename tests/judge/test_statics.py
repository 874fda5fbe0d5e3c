"""Balance against the closed forms of statics: ladders, cards, logs, arches, and what hangs in the air."""

import math

import numpy as np
import pytest

from schemas.scene.shape import Mesh
from tests.judge.judge import Thing, Verdict, judge
from tests.judge.solids import ball, box, joined, moved, prism, rotation

FLOOR = box((4.0, 4.0, 0.1), (0.0, 0.0, -0.05))
BALANCED = 1e-3


def about_y(mesh: Mesh, degrees: float) -> Mesh:
    return moved(mesh, rotation((0.0, 1.0, 0.0), degrees))


def on_ground(mesh: Mesh) -> Mesh:
    return moved(mesh, at=(0.0, 0.0, -mesh.vertices[:, 2].min()))


def thing(mesh: Mesh, mass_kg: float = 1.0) -> Thing:
    """Of a mesh that is its own mirror image about the middle of its box."""
    return Thing(mesh, mass_kg, (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2)


def unbalanced(found: tuple[Verdict, ...]) -> float:
    assert max(each.overlap_mm for each in found) < 1e-6
    return max(each.unbalanced for each in found)


@pytest.mark.parametrize(("more_deg", "held"), [(0.5, True), (-0.5, False)])
@pytest.mark.parametrize("friction", [0.25, 0.5])
def test_a_ladder_leans_on_a_wall_down_to_the_angle_of_both_frictions(friction, more_deg, held):
    """Friction at wall and floor: tan(least angle to the floor) = (1 - mu^2) / (2 mu)."""
    angle = math.degrees(math.atan((1.0 - friction**2) / (2.0 * friction))) + more_deg
    ladder = about_y(prism([(-0.5, 0.0), (0.0, -0.01), (0.5, 0.0), (0.0, 0.01)], 0.1), angle)
    ladder = moved(on_ground(ladder), at=(-ladder.vertices[:, 0].min(), 0.0, 0.0))
    wall = box((0.1, 4.0, 2.0), (-0.05, 0.0, 1.0))
    assert (unbalanced(judge([thing(ladder)], joined(FLOOR, wall), friction)) < BALANCED) == held


@pytest.mark.parametrize(("lean_deg", "held"), [(25.0, True), (28.0, False)])
def test_two_cards_lean_on_one_another_up_to_twice_the_friction(lean_deg, held):
    """Each pushes the other with half its weight times the tangent of its lean: 26.6 degrees at a friction of 0.25."""
    card = on_ground(about_y(box((0.0003, 0.06, 0.09)), lean_deg))
    left = moved(card, at=(-card.vertices[:, 0].max(), 0.0, 0.0))
    right = Mesh(left.vertices * [-1.0, 1.0, 1.0], left.faces[:, ::-1])
    assert (unbalanced(judge([thing(left), thing(right)], FLOOR, 0.25)) < BALANCED) == held


@pytest.mark.parametrize(("friction", "held"), [(0.30, True), (0.24, False)])
def test_three_logs_hold_with_a_friction_of_the_tangent_of_15_degrees(friction, held):
    """One log on two that touch: 0.268 where they touch, 0.089 on the floor."""
    outline = [(0.05 * math.cos(a), 0.05 * math.sin(a)) for a in np.radians(np.arange(0.5, 360.0, 1.0))]
    log = on_ground(prism(outline, 0.3))
    half = log.vertices[:, 0].max()
    height = math.sqrt(3.0) * half  # flat sides face one another at 60 degrees
    logs = [moved(log, at=at) for at in ((-half, 0.0, 0.0), (half, 0.0, 0.0), (0.0, 0.0, height))]
    assert (unbalanced(judge([thing(each) for each in logs], FLOOR, friction)) < BALANCED) == held


@pytest.mark.parametrize(("thickness", "held"), [(0.110, True), (0.105, False)])
def test_a_round_arch_stands_from_a_tenth_of_its_radius(thickness, held):
    """Milankovitch 1907: half a circle of wedges stands from a thickness of 0.1075 of its middle radius, if none slides."""
    count = 18
    cuts = np.radians(np.linspace(0.0, 180.0, count + 1))
    ends = [[(r * math.cos(a), r * math.sin(a)) for a in cuts] for r in (1.0 - thickness / 2, 1.0 + thickness / 2)]
    stones = []
    for k in range(count):
        stone = prism([ends[0][k], ends[1][k], ends[1][k + 1], ends[0][k + 1]], 0.2)
        stones.append(Thing(stone, 1.0, _middle(stone)))
    assert (unbalanced(judge(stones, FLOOR, 0.8)) < BALANCED) == held


def _middle(mesh: Mesh) -> np.ndarray:
    """The centre of mass of a convex body."""
    corners = mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0)
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return mesh.vertices.mean(axis=0) + (volumes[:, None] * corners.sum(axis=1) / 4.0).sum(axis=0) / volumes.sum()


@pytest.mark.parametrize("masses", [(1.0, 1000.0), (1000.0, 1.0)])
def test_a_stack_is_balanced_at_any_ratio_of_masses(masses):
    lower, upper = box((0.1, 0.1, 0.1), (0.0, 0.0, 0.05)), box((0.1, 0.1, 0.1), (0.04, 0.0, 0.15))
    assert unbalanced(judge([thing(lower, masses[0]), thing(upper, masses[1])], FLOOR, 0.25)) < 1e-6


def test_a_heavy_box_beyond_the_edge_of_a_light_one_is_not_held_by_it():
    lower, upper = box((0.1, 0.1, 0.1), (0.0, 0.0, 0.05)), box((0.1, 0.1, 0.1), (0.07, 0.0, 0.15))
    assert unbalanced(judge([thing(lower, 0.001), thing(upper, 1.0)], FLOOR, 0.25)) > 0.1


def test_two_balls_one_on_the_slope_of_the_other_are_not_balanced():
    """20 degrees off the top. A force along the normal alone leaves sin 20 = 0.34, a vertical one alone a moment of 0.15."""
    lower, upper = ball(0.05, (0.0, 0.0, 0.05)), ball(0.05)
    off = rotation((0.0, 1.0, 0.0), 22.5) @ np.array([0.0, 0.0, 0.1])
    found = judge([thing(lower), thing(moved(upper, at=off + np.array([0.0, 0.0, 0.05])))], FLOOR, 0.25)
    assert 0.05 < found[1].unbalanced < 0.16


def test_what_holds_only_one_another_in_the_air_touches_and_hangs():
    pair = [box((0.1, 0.1, 0.1), (0.0, 0.0, z)) for z in (1.05, 1.15)]
    found = judge([thing(each) for each in pair], FLOOR, 0.25)
    assert [each.hover_mm for each in found] == [0.0, 0.0]
    assert max(each.unbalanced for each in found) == pytest.approx(1.0, abs=1e-3)


def test_a_box_beside_another_is_not_held_by_its_side():
    """Flush walls push sideways at most: what has nothing below it is not held, whatever it touches."""
    standing, hanging = box((0.1, 0.1, 0.3), (0.0, 0.0, 0.15)), box((0.1, 0.1, 0.1), (0.1, 0.0, 0.2))
    found = judge([thing(standing), thing(hanging)], FLOOR, 0.25)
    assert found[0].unbalanced < BALANCED and found[1].unbalanced > 0.5

"""One step of bodies from rest, and the forces in balance, against what can be worked out by hand."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit.contacts import UP, box, contacts_between, mesh_of, thing_of, tipped
from workers.geometry.frames import pose, rotation_about
from workers.physics import exact_rest as module
from workers.physics.exact_rest import MANY, JammedError, Motion, step

WITHIN_M = 5e-5
FALL_M = 1e-4
G = 9.81
GROUND = box((1.0, 1.0, 0.1), (0, 0, -0.05))


def follow(
    bodies: list[Mesh], ground: Mesh = GROUND, friction: float = 0.5, masses=None, fall_m: float = FALL_M
) -> Motion:
    masses = masses or [1.0] * len(bodies)
    inertias = [thing_of(mesh, mass).inertia(np.eye(4)) for mesh, mass in zip(bodies, masses, strict=True)]
    return step(inertias, contacts_between([*bodies, ground], WITHIN_M), friction, -fall_m * UP, G)


def moved(motion: Motion) -> float:
    """As a share of free fall."""
    return float(max(np.abs(motion.moves).max(), np.abs(motion.turns).max())) / FALL_M


def test_in_the_air_all_fall_alike():
    motion = follow([box((0.1, 0.1, 0.1), (0, 0, 1.0)), box((0.2, 0.1, 0.1), (0.5, 0, 2.0))], masses=[1.0, 50.0])
    assert motion.moves == pytest.approx(np.tile(-FALL_M * UP, (2, 1)), abs=1e-15)
    assert motion.turns == pytest.approx(0.0, abs=1e-15) and len(motion.forces) == 0


def test_what_hovers_a_little_comes_down_to_touch():
    motion = follow([box((0.1, 0.1, 0.1), (0, 0, 0.05 + 3e-5))])
    assert motion.moves[0] == pytest.approx(-3e-5 * UP, abs=1e-12)


def test_what_overlaps_is_lifted_out():
    motion = follow([box((0.1, 0.1, 0.1), (0, 0, 0.05 - 4e-5))])
    assert motion.moves[0] == pytest.approx(4e-5 * UP, abs=1e-12)


def test_at_rest_forces_balance_every_weight():
    bodies = [box((0.1, 0.1, 0.1), (0, 0, 0.05)), box((0.05, 0.05, 0.05), (0.01, 0, 0.125))]
    contacts = contacts_between([*bodies, GROUND], WITHIN_M)
    motion = follow(bodies, masses=[2.0, 3.0])
    assert moved(motion) < 1e-9
    table = contacts.lower == 2
    assert motion.forces[table].sum(axis=0) == pytest.approx([0, 0, 5 * G], abs=1e-9)
    assert motion.forces[~table].sum(axis=0) == pytest.approx([0, 0, -3 * G], abs=1e-9)  # on the lower one


@pytest.mark.parametrize(("angle", "stands"), [(0.0, True), (0.46, True), (0.4637, False), (0.6, False)])
def test_a_box_stands_on_a_slope_up_to_the_angle_of_friction(angle, stands):
    """tan 0.4636 = 0.5."""
    turn = tipped(angle)
    slope = mesh_of(trimesh.creation.box((1.0, 1.0, 0.1)), pose(turn, -0.05 * turn[:, 2]))
    motion = follow([box((0.1, 0.1, 0.04), 0.02 * turn[:, 2], turn)], slope)
    if stands:
        assert moved(motion) < 1e-9
    else:  # down the slope, by what the cone does not hold
        assert motion.moves[0] @ turn[:, 0] > 0.5 * FALL_M * (np.sin(angle) - 0.5 * np.cos(angle)) * 0.99


@pytest.mark.parametrize("turned", [0.1, 0.2, 0.39])
def test_a_slope_has_all_of_its_friction_whichever_way_it_falls(turned):
    """The pyramid's edges follow the slope; 22 degrees off an edge it would have 92 % of it."""
    turn = rotation_about(UP, turned) @ tipped(np.arctan(0.495))
    slope = mesh_of(trimesh.creation.box((1.0, 1.0, 0.1)), pose(turn, -0.05 * turn[:, 2]))
    assert moved(follow([box((0.1, 0.1, 0.04), 0.02 * turn[:, 2], turn)], slope)) < 1e-9


@pytest.mark.parametrize(("friction", "stands"), [(0.30, True), (0.26, False)])
def test_a_ladder_against_a_wall_needs_its_friction(friction, stands):
    """With friction m at floor and wall alike it holds up to tan a = 2 m / (1 - m^2) from the vertical; here a = 0.55:
    m = tan(a / 2) = 0.2822."""
    ladder = box((0.01, 0.3, 2.0), turn=tipped(0.55))
    low, high = ladder.vertices.min(axis=0), ladder.vertices.max(axis=0)
    floor = trimesh.creation.box((9.0, 9.0, 1.0)).apply_translation((0, 0, low[2] - 0.5))
    wall = trimesh.creation.box((1.0, 9.0, 8.0)).apply_translation((high[0] + 0.5, 0, low[2] + 4.0))
    motion = follow([ladder], mesh_of(trimesh.util.concatenate([floor, wall])), friction)
    assert moved(motion) < 1e-9 if stands else moved(motion) > 1e-3


@pytest.mark.parametrize(("over_m", "stands"), [(0.02, True), (0.0499, True), (0.0501, False)])
def test_of_a_stack_the_upper_may_not_hang_over_by_half(over_m, stands):
    motion = follow([box((0.1, 0.1, 0.1), (0, 0, 0.05)), box((0.1, 0.1, 0.1), (over_m, 0, 0.15))])
    assert (moved(motion) < 1e-9) == stands
    assert stands or motion.turns[1, 1] > 0.0  # about y, to the side that hangs over


@pytest.mark.parametrize(("mass", "stands"), [(0.79, False), (0.81, True), (500.0, True)])
def test_the_lower_of_a_stack_bears_the_upper(mass, stands):
    """On a plate's overhanging end, 0.04 m out, a body of 1 kg needs 0.8 kg of plate, whose middle is 0.05 m in."""
    plate, load = box((0.2, 0.1, 0.01), (0.45, 0, 0.005)), box((0.02, 0.02, 0.02), (0.54, 0, 0.02))
    assert (moved(follow([plate, load], masses=[mass, 1.0])) < 1e-6) == stands


@pytest.mark.parametrize("masses", [[1.0, 1000.0], [1000.0, 1.0]])
def test_forces_are_shared_between_a_thousandfold_of_masses(masses):
    bodies = [box((0.1, 0.1, 0.1), (0, 0, 0.05)), box((0.1, 0.1, 0.1), (0.01, 0, 0.15))]
    assert moved(follow(bodies, masses=masses)) < 1e-7


def test_energy_is_never_gained_where_nothing_overlaps():
    """The heights' sum, weighted by mass, sinks in every direction that a leaning box may go."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        turn = rotation_about(UP, rng.uniform(0, 6)) @ tipped(rng.uniform(0.01, 0.4))
        cube = box((0.1, 0.08, 0.05), turn=turn)
        cube = Mesh(cube.vertices - [0, 0, cube.vertices[:, 2].min()], cube.faces)
        assert follow([cube]).moves[0, 2] < 0.0


def test_what_no_motion_can_free_is_jammed():
    """A box in a slot that is narrower than it."""
    walls = [trimesh.creation.box((0.1, 1.0, 1.0)).apply_translation((x, 0, 0)) for x in (-0.1 + 2e-5, 0.1 - 2e-5)]
    with pytest.raises(JammedError):
        follow([box((0.1, 0.1, 0.1))], mesh_of(trimesh.util.concatenate(walls)))


def columns(count: int) -> list[Mesh]:
    """Boxes in columns of five, turned at random about the vertical, with 20 micrometres below each but the lowest."""
    rng, bodies = np.random.default_rng(7), []
    for number in range(count):
        turn = rotation_about(UP, rng.uniform(0, 6))
        at = 0.09 * (number // 5), rng.uniform(-0.005, 0.005), 0.025 + 0.05002 * (number % 5)
        bodies.append(box((0.06, 0.06, 0.05), at, turn))
    return bodies


@pytest.mark.parametrize("fall_m", [1e-4, 1e-2])
def test_the_two_solvers_agree(fall_m, monkeypatch):
    """DAQP and Clarabel share no code: an active set and an interior point."""
    bodies, both = columns(MANY), []
    for least in (MANY, MANY + 1):
        monkeypatch.setattr(module, "MANY", least)
        both.append(follow(bodies, fall_m=fall_m))
    assert both[0].moves == pytest.approx(both[1].moves, abs=1e-7 * fall_m)
    assert both[0].turns == pytest.approx(both[1].turns, abs=1e-6 * fall_m)
    assert np.abs(both[0].moves).max() > 0.1 * FALL_M and not np.array_equal(both[0].moves, both[1].moves)


def test_many_bodies_may_be_jammed_too():
    walls = [trimesh.creation.box((0.1, 9.0, 1.0)).apply_translation((x, 0, 0)) for x in (-0.1 + 2e-5, 0.1 - 2e-5)]
    bodies = [box((0.1, 0.1, 0.1), (0, 0.2 * number, 0)) for number in range(MANY)]
    with pytest.raises(JammedError):
        follow(bodies, mesh_of(trimesh.util.concatenate(walls)))


def test_what_falls_aslant_goes_the_way_of_the_fall():
    body = [thing_of(box((0.1, 0.1, 0.1), (0, 0, 1.0))).inertia(np.eye(4))]
    fall = np.array([1e-5, -2e-5, -1e-4])
    motion = step(body, contacts_between([box((0.1, 0.1, 0.1), (0, 0, 1.0)), GROUND], WITHIN_M), 0.5, fall, G)
    assert motion.moves[0] == pytest.approx(fall, abs=1e-15)

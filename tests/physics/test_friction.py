"""Sliding, against Coulomb. The friction of a contact is the product of both bodies', here of one with itself."""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest
import trimesh

from tests.hard_cases.drops import table_of
from tests.hard_cases.groups import Group, together
from tests.hard_cases.slope_cases import on_wedge
from tests.judge.judge import judge
from tests.judge.scenes import frictions_of, things_at_rest
from tests.kit.contacts import box as box_mesh
from tests.kit.contacts import contacts_between, thing_of, tipped
from tests.kit.gravity import set_gravity
from tests.kit.shapes import asset_of, box
from tests.physics.room import MARGIN_M, PHYSICS, G, advance, at, box_body, drop, order, physics, slope
from tests.physics.settling import settle_group
from workers.geometry.frames import DOWN, transform
from workers.physics.bullet import contact_friction
from workers.physics.exact_rest import step

MU = PHYSICS.friction_of("table") ** 2
CRITICAL_RAD = math.atan(MU)
RATES_HZ = (480, 960, 1920, 3840)
FLAT = box_body(0.2, 0.2, 0.01)
"""So low that it neither leans nor tips."""


def slid(rate_hz: int, speed_m_s: float) -> float:
    """Metres that the box slides on level ground when it is pushed, after it has come to rest."""
    settings = physics(step_hz=rate_hz)
    with drop(FLAT, at(0, 0.005 + MARGIN_M), 0.0, settings, 1) as world:
        advance(world, rate_hz)
        before = world.pose()[0][0]
        world.set_velocity((speed_m_s, 0.0, 0.0))
        advance(world, rate_hz)
        return world.pose()[0][0] - before


def speed_on_slope(rate_hz: int, angle_rad: float, heading_rad: float, category: str = "", **more: object) -> float:
    """Speed, m/s, that the box has half a second after the level ground under it became a slope."""
    settings = physics(step_hz=rate_hz, **more)
    with drop(dataclasses.replace(FLAT, category=category), at(0, 0.005 + MARGIN_M), 0.0, settings, 1) as world:
        advance(world, rate_hz)
        set_gravity(world, slope(angle_rad, heading_rad))
        advance(world, rate_hz // 2)
        return math.hypot(*world.velocity()[0][:2])


def test_a_box_slides_as_far_as_its_friction_lets_it(record_figure):
    """v^2 / (2 mu g), less half a step at the first speed: semi-implicit Euler brakes before it moves.

    Beyond that two thousandths of the way at 960 Hz, where corners of the box lose the ground for single steps.
    """
    exact = 1.0 / (2 * MU * G)
    errors = [slid(rate, 1.0) - exact for rate in RATES_HZ[1:]]
    beyond = [abs(error + 0.5 / rate) for rate, error in zip(RATES_HZ[1:], errors, strict=True)]
    record_figure("sliding distance: error at 960 Hz, mm", "passed", errors[0] * 1e3, -0.5e3 / 960)
    record_figure("sliding distance: beyond half a step at 960 Hz, share", "passed", beyond[0] / exact, 2e-3)
    for rate, found in zip(RATES_HZ[1:], beyond, strict=True):
        assert found < 2e-3 * exact * (960 / rate)


@pytest.mark.parametrize("heading_deg", [0.0, 45.0, 57.3])
def test_a_slope_accelerates_a_box_by_what_friction_leaves_of_gravity(heading_deg, record_figure):
    """a = g (sin - mu cos), so that a speed tells the friction, in every direction: a cone, not a pyramid."""
    angle = math.radians(35.0)
    found = [
        math.tan(angle) - speed_on_slope(rate, angle, math.radians(heading_deg)) / (G * 0.5 * math.cos(angle))
        for rate in RATES_HZ
    ]
    errors = [math.degrees(math.atan(mu) - CRITICAL_RAD) for mu in found]
    name = f"critical angle towards {heading_deg:g} degrees"
    record_figure(f"{name}: error at 960 Hz, degrees", "passed", errors[1], 0.25)
    # A pyramid would be off by up to ten degrees. Off the axes the contacts' friction acts along directions of one step ago.
    assert max(map(abs, errors)) < 0.25
    if heading_deg == 0.0:
        record_figure(f"{name}: order in the step", "passed", order(RATES_HZ, errors), 1.0)
        assert order(RATES_HZ, errors) > 0.9


@pytest.mark.parametrize("heading_deg", [0.0, 30.0])
def test_a_box_stands_just_below_the_critical_angle_and_slides_just_above(heading_deg, record_figure):
    heading, near = math.radians(heading_deg), math.radians(0.2)
    below, above = (speed_on_slope(960, CRITICAL_RAD + sign * near, heading) for sign in (-1, 1))
    record_figure(f"critical angle {heading_deg:g}: speed 0.2 degrees below, mm/s", "passed", below * 1e3, 1.0)
    assert below < 1e-3
    assert above == pytest.approx(G * math.sin(near) / math.cos(CRITICAL_RAD) * 0.5, rel=0.4)


# ---------------------------------------------------------------------------------------------- by category

FRICTIONS = {"box": 0.8, "mug": 0.5, "can": 0.4, "table": 1.0}
"""A mug stands on the table up to atan 0.5, 26.6 degrees, and on a box up to atan 0.4, 21.8 degrees."""


@pytest.mark.parametrize(("category", "mu"), [("mug", 0.5), ("can", 0.4), ("laptop", 0.7)])
def test_a_body_slides_in_the_simulator_from_the_angle_of_its_own_friction(category, mu):
    """A laptop has no coefficient of its own, and so the default."""
    near = math.radians(0.2)
    below, above = (
        speed_on_slope(960, math.atan(mu) + sign * near, 0.0, category, friction=FRICTIONS) for sign in (-1, 1)
    )
    assert below < 1e-3
    assert above == pytest.approx(G * math.sin(near) / math.cos(math.atan(mu)) * 0.5, rel=0.4)


def test_no_contact_has_more_friction_than_ten_in_the_simulator_nor_in_exact_rest():
    """Of 25, the product of two bodies' 5, Bullet leaves 10: `a = g (sin - mu cos)`, beyond atan 10 and below atan 25."""
    angle = math.atan(20.0)
    speed = speed_on_slope(3840, angle, 0.0, friction=5.0)
    assert speed == pytest.approx(0.5 * G * (math.sin(angle) - 10.0 * math.cos(angle)), rel=0.01)
    assert float(contact_friction(5.0, 5.0)) == 10.0


def test_of_two_on_one_slope_the_one_whose_friction_is_below_its_tangent_slides_in_exact_rest_by_what_friction_leaves():
    """Free fall by f, carried onto the nearest edge of the cone, goes f (sin - mu cos) / (1 + mu^2) down the slope."""
    sides, angle, fall_m = (0.05, 0.05, 0.005), math.atan(0.45), 1e-4
    meshes = [box_mesh(sides, tipped(angle) @ [0.0, y, 0.0025], tipped(angle)) for y in (-0.2, 0.2)]
    contacts = contacts_between(
        [*meshes, box_mesh((2.0, 2.0, 0.1), tipped(angle) @ [0.0, 0.0, -0.05], tipped(angle))], 1e-6
    )
    inertias = [thing_of(mesh).inertia(np.eye(4)) for mesh in meshes]
    motion = step(inertias, np.array([0.625, 0.5, 0.8]), contacts, fall_m * DOWN)  # contacts have 0.5 and 0.4
    down = motion.moves @ tipped(angle)[:, 0]
    slid = fall_m * (math.sin(angle) - 0.4 * math.cos(angle)) / (1.0 + 0.4**2)
    assert down == pytest.approx([0.0, slid], abs=1e-12)
    holding = motion.forces[contacts.of(0)].sum(axis=0)
    assert holding == pytest.approx([0.0, 0.0, G], abs=1e-6)  # of a kilogram


def ramp(angle_deg: float) -> Group:
    """A mug on a slope that is part of the table."""
    group = on_wedge(MUG, angle_deg)
    wedge, T = group.starts[0].asset.shape.mesh, group.starts[0].T_world_obj
    slope = trimesh.Trimesh(transform(T, wedge.vertices), wedge.faces, process=False)
    table = table_of(box(1.4, 1.4, 0.03, (0, 0, 0.685)), slope)
    return together(table, group.starts[1:])


MUG = asset_of(box(0.05, 0.05, 0.03), category="mug")


@pytest.mark.parametrize("beyond_deg", [-0.7, 0.7])
@pytest.mark.parametrize(("on", "mu"), [(ramp, 0.5), (partial(on_wedge, MUG), 0.4)], ids=["table", "box"])
def test_a_mug_comes_to_rest_on_a_slope_up_to_the_product_of_both_frictions(on, mu, beyond_deg):
    """On the table, and on a wedge of the category box. The judge weighs what rests with the same products."""
    settings, case = physics(friction=FRICTIONS), on(math.degrees(math.atan(mu)) + beyond_deg)
    settled = settle_group(case.starts, case.table, settings)
    slid_m = float(np.linalg.norm(settled[-1].T_world_obj[:2, 3] - case.starts[-1].T_world_obj[:2, 3]))
    assert slid_m < 1e-3 if beyond_deg < 0.0 else slid_m > 0.05
    verdicts = judge(things_at_rest(case.starts, settled), case.table.mesh, frictions_of(case.starts, settings))
    assert max(verdict.unbalanced for verdict in verdicts) < 1e-3

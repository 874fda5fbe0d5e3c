"""Objects from release to rest, held there and let go again, against mechanics in closed form and geometry."""

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from schemas.errors import SettleError
from schemas.scene.scene import EffectPlan, ObjectStart, Settled, Table
from schemas.scene.shape import Mesh
from tests.hard_cases.bodies import ball, built_in, cube, over_edge
from tests.hard_cases.drops import Y, drop, level, turn
from tests.hard_cases.groups import place as at
from tests.hard_cases.groups import put, together, tray
from tests.hard_cases.hollow_cases import cups
from tests.kit.shapes import asset_of, box
from tests.physics.settling import (
    PHYSICS,
    effects_of,
    recheck,
    recheck_group,
    scene_of,
    settle_group,
    settle_single,
)
from workers.geometry.frames import rotation_about, translation
from workers.physics import ending, settle
from workers.physics import hold as holding
from workers.physics import release as releasing
from workers.physics.bullet import World
from workers.physics.convex_parts import parts_of
from workers.physics.effects import called_for
from workers.physics.exact_rest import Rested
from workers.physics.fall import FINEST, LOOK_STEPS, SAMPLE_STEPS, Outcome, fall
from workers.physics.hold import HELD, MOST_HOLDS, RELEASE_RATE, hold, release_again
from workers.physics.placement import Placement, forms_of, place
from workers.physics.pour import NOTHING_MORE, Pouring, points_of
from workers.physics.release import (
    DOUBTFUL_RISE,
    KNOWN_RISE,
    MANY,
    MOST_RISE,
    PACES,
    PACES_MANY,
    PACES_TOGETHER,
    Drop,
    release,
)
from workers.physics.settle import LEFT_ROOM, LEFT_TOP, MOST_RELEASES, RECHECK_S, Rest, settle_scene

TABLE = level()
TOP = TABLE.top.height_m
ALL = ("dynamics", "fine_step", "object_contacts", "rolling_friction")
CUBE = cube(0.06)
X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
LEANS = turn(X, 1.0)
"""So that it does not stand where it lands, and falls in the simulator."""


def group_of(starts: Sequence[ObjectStart], physics=PHYSICS) -> tuple[Settled, ...]:
    return settle_group(starts, TABLE, physics, ALL)


def scene(starts: list[ObjectStart], physics=PHYSICS) -> Rest:
    """With what the scene calls for from its start."""
    return settle_scene(scene_of(starts, TABLE), physics, effects_of(starts, TABLE, physics))


def test_objects_far_apart_settle_each_as_it_would_alone_to_the_last_bit():
    lean, plate = turn(X, 11.0), asset_of(box(0.1, 0.05, 0.02))
    starts = [at(CUBE, TABLE, (-0.3, 0.0, 0.05), lean), at(plate, TABLE, (0.3, 0.1, 0.1), lean.T)]
    rest = scene(starts)
    assert rest.called == {}
    for start, each in zip(starts, rest.settled, strict=True):
        alone = settle_single(start, TABLE, PHYSICS)
        assert each.T_world_obj.tobytes() == alone.T_world_obj.tobytes()
        assert (each.settle_s, each.support) == (alone.settle_s, alone.support)


def test_contacts_are_called_for_after_all_where_a_ball_rolls_towards_another_object():
    """On facets of a coarse ball, let go above one of its edges: it rolls off by more than its room of 12 mm."""
    smooth, R = PHYSICS.model_copy(update={"rolling_friction": 0.0}), rotation_about(Y, 0.1)
    starts = [at(ball(0.05, 2), TABLE, (x, 0, 0.3), R) for x in (0.0, 0.05 + 0.05 + 2 * 0.012)]
    assert "object_contacts" not in called_for(starts, TABLE, smooth)
    assert scene(starts, smooth).called == {"object_contacts": LEFT_ROOM}


def test_the_mesh_is_called_for_after_all_where_one_of_two_leaves_the_flat_top():
    """Of several that fall together it is told by where they come to rest: here a third of a cube is beyond the edge."""
    starts = [at(CUBE, TABLE, (-0.3, 0.0, 0.04)), at(CUBE, TABLE, (0.69, 0.0, 0.04))]
    rest = group_of(starts)
    assert {each.support for each in rest} == {"mesh"}
    assert rest[1].support_margin_mm == pytest.approx(10.0, abs=0.5)
    near = [starts[0], at(CUBE, TABLE, (0.65, 0.0, 0.1))]
    assert "table_mesh" not in called_for(near, TABLE, PHYSICS)
    assert scene(near).called == {"table_mesh": LEFT_TOP}


def test_objects_that_begin_inside_one_another_are_refused_and_not_thrown_apart():
    for deep_m, refused in ((0.059, True), (0.002, True), (5e-5, False), (-1e-4, False)):
        starts = together(TABLE, [at(CUBE, TABLE, (x, 0, 0.031)) for x in (0.0, 0.06 - deep_m)]).starts
        if refused:
            with pytest.raises(SettleError, match=f"regions 3 and 4 begin {deep_m * 1e3:.2f} mm") as caught:
                group_of(starts)
            assert caught.value.reason == "objects_overlap"
        else:
            assert group_of(starts)[1].T_world_obj[0, 3] == pytest.approx(0.06 - deep_m, abs=1e-3)


def test_the_forces_of_a_pile_prove_its_balance():
    """Of every object they add to its weight, and two that touch press one another alike."""
    for each in group_of([at(CUBE, TABLE, (0.012 * k, 0.007 * (-1) ** k, 0.04 + 0.1 * k)) for k in range(4)]):
        force = sum(contact.force for contact in each.contacts)
        assert force == pytest.approx([0, 0, CUBE.mass.mass_kg * 9.81], abs=1e-6)
        assert each.equilibrium_residual < 1e-6 and each.penetration_mm < 1e-6 and each.hover_gap_mm < 1e-6


def test_what_does_not_rest_is_refused_with_what_was_measured(monkeypatch):
    """A ball in a hurry, a cube half over the edge, and the gate, whatever brings an object 0.02 mm above the table."""
    hurried = PHYSICS.model_copy(update={"max_settle_s": 0.1})
    fine = dataclasses.replace(TABLE, top=dataclasses.replace(TABLE.top, convex=False))
    fine = dataclasses.replace(fine, mesh=Mesh(np.tile(TABLE.mesh.vertices, (3300, 1)), TABLE.mesh.faces))
    beyond, hover = over_edge(0.6).start, at(CUBE, TABLE, (0, 0, 0.03 + 2e-5))
    for start, on, physics, reason, words in (
        (at(ball(0.05, 2), TABLE, (0, 0, 0.2)), TABLE, hurried, "not_at_rest", r"rad/s after 0\.1 s"),
        (beyond, TABLE, PHYSICS, "left_table", r"off the table's top: narrow start.offset_m"),
        # PyBullet itself stops with `createCollisionShape failed`, which would end the worker
        (at(CUBE, TABLE, (0, 0, 0.1), LEANS), fine, PHYSICS, "table_too_fine", "takes 131072 and 174762"),
        (hover, TABLE, PHYSICS, "unsupported", r"it came to rest 0.020 mm from anything, with 100.0% of its weight"),
    ):
        if start is hover:
            monkeypatch.setattr(Placement, "rest", lambda *_: Rested((hover.T_world_obj,), True, 0))
        with pytest.raises(SettleError, match=words) as caught:
            settle_single(start, on, physics)
        assert caught.value.reason == reason


def test_the_gate_refuses_a_gap_an_overlap_and_an_imbalance_each_by_itself():
    """At the bounds of docs/rest.md: 0.01 mm and 0.1 % of the weight."""
    start = at(CUBE, TABLE, (0, 0, 0.03))
    for gap_mm, unbalanced, words in (
        (0.0, 0.0, None),
        (0.0099, 0.0009, None),
        (-0.0099, 0.0009, None),
        (0.0101, 0.0, "0.010 mm from anything"),
        (-0.0101, 0.0, "0.010 mm inside what it touches"),
        (0.0, 0.0011, "with 0.1% of its weight out of balance"),
    ):
        held = SimpleNamespace(gap_m=gap_mm * 1e-3, unbalanced=unbalanced)
        refused = pytest.raises(SettleError, match=words) if words else contextlib.nullcontext()
        with refused:
            ending._require_support(
                SimpleNamespace(drop=SimpleNamespace(single=True, starts=[start]), poses=()), 0, held
            )


# ---------------------------------------------------------------------------------------------- paces


def told_by(monkeypatch, change=lambda outcome: outcome) -> list[tuple]:
    """(steps, outcome) of each fall from now on."""
    seen = list[tuple]()

    def told(*given, **more):
        seen.append((given[4], change(fall(*given, **more))))
        return seen[-1][1]

    for module in (releasing, holding):
        monkeypatch.setattr(module, "fall", told)
    return seen


def test_steps_are_as_fine_as_the_highest_fall_and_the_thinnest_object_ask(monkeypatch):
    """For several 2 mm, or 0.002 of the fall if that is more, or 0.05 of the thinnest if that is less."""
    for height_m, side_m, travel_m in ((0.02, 0.06, 2e-3), (1.5, 0.06, 3e-3), (0.3, 0.006, 3e-4)):
        with monkeypatch.context() as patch:
            seen = told_by(patch)
            group_of(
                [at(CUBE, TABLE, (0, 0, 0.031), LEANS), at(cube(side_m), TABLE, (0.2, 0.0, height_m + side_m / 2))]
            )
        told = [(steps.base_hz, pytest.approx(steps.max_travel_m)) for steps, _ in seen]
        assert told == [(PHYSICS.step_hz, travel_m)]


NEVER = -1.0


def test_what_gains_energy_falls_again_in_shorter_steps_until_it_gains_none(monkeypatch):
    """(rate over the job's, steps between looks) of one fall after the other, when energy rises by these shares of its bound.

    NEVER is of objects that did not rest: several fall again, and one that rolls on does not.
    """
    plan = EffectPlan(("dynamics", "fine_step", "object_contacts", "decomposition"), {})
    brief = PHYSICS.model_copy(update={"max_settle_s": 0.01})

    def told(outcome: Outcome, rise: float) -> Outcome:
        return dataclasses.replace(outcome, rise=max(0.0, rise), rested=rise != NEVER)

    def falls_of(starts: Sequence[ObjectStart], rises: list[float]) -> list[tuple[float, int]]:
        left = iter(rises)
        drop = Drop(tuple(starts), TABLE, brief, plan if len(starts) >= MANY else EffectPlan(plan.ran[:2], {}))
        with monkeypatch.context() as patch:
            seen = told_by(patch, lambda outcome: told(outcome, next(left)))
            release(drop, True, drop.ways[0])
        return [(steps.base_hz / PHYSICS.step_hz, steps.looked) for steps, _ in seen]

    alone = [at(CUBE, TABLE, (0, 0, 0.031))]
    both = [at(CUBE, TABLE, (x, 0, 0.031)) for x in (-0.2, 0.2)]
    mugs = [at(built_in("mug"), TABLE, (0.2 * k - 0.3, 0.0, 0.06)) for k in range(MANY)]
    looked = [(pace.rate, LOOK_STEPS) for pace in PACES]
    sampled = [(pace.rate, SAMPLE_STEPS) for pace in PACES_TOGETHER]
    for starts, rises, expected in (
        (alone, [0.99 * DOUBTFUL_RISE], looked[:1]),
        (alone, [1.01 * DOUBTFUL_RISE, 0.99 * KNOWN_RISE], [looked[0], (PACES[0].rate, 1)]),
        (alone, [1.01 * KNOWN_RISE] * 2 + [0.0], looked[:3]),
        (alone, [1.01 * KNOWN_RISE] * 9, looked),
        (alone, [NEVER], looked[:1]),
        (both, [0.99 * MOST_RISE], sampled[:1]),
        (both, [NEVER] * 2, sampled),
        (both, [1.01 * MOST_RISE] * 9, sampled),
        (mugs, [1.01 * MOST_RISE] * 9, [(PACES_MANY[0].rate, SAMPLE_STEPS)]),
    ):
        assert falls_of(starts, rises) == expected, (len(starts), rises)


def test_no_way_is_fallen_again_that_would_be_the_same_once_more(monkeypatch):
    """Two cubes that never stay: the last way falls at the last pace, as the first has where energy always rose at the other."""
    monkeypatch.setattr(settle, "hold", lambda _drop, _placement, poses: Rested(tuple(poses), False, 0, balanced=True))
    starts = [at(CUBE, TABLE, (x, 0, 0.031), LEANS) for x in (-0.2, 0.2)]
    coarse, fine = (pace.rate * PHYSICS.step_hz for pace in PACES_TOGETHER)
    for rise, expected in (
        (1.0, [coarse, fine] * MOST_RELEASES),
        (0.0, [coarse] * MOST_RELEASES + [fine] * MOST_RELEASES),
    ):
        with monkeypatch.context() as patch:
            seen = told_by(patch, lambda outcome, rise=rise: dataclasses.replace(outcome, rise=rise))
            with pytest.raises(SettleError, match="tips or slips on without end"):
                group_of(starts)
        assert [steps.base_hz for steps, _ in seen] == expected


def test_a_pile_that_finds_no_balance_falls_again_as_parts_as_fine_as_they_are(monkeypatch):
    """Coarse parts are up to three millimetres too small: walls stay in one another, however often the pile falls as they."""
    monkeypatch.setattr(settle, "hold", lambda _drop, _placement, poses: Rested(tuple(poses), False, 0, balanced=True))
    fine, fallen = MANY * len(parts_of(built_in("mug"), PHYSICS.concavity)), list[int]()

    def counted(bodies, *given, **more):
        fallen.append(sum(len(body.parts) for body in bodies))
        return fall(bodies, *given, **more)

    monkeypatch.setattr(releasing, "fall", counted)
    starts = [at(built_in("mug"), TABLE, (0.2 * k - 0.3, 0.0, 0.06), LEANS) for k in range(MANY)]
    with pytest.raises(SettleError, match="tips or slips on without end"):
        settle_group(starts, TABLE, PHYSICS, (*ALL, "decomposition"))
    assert max(fallen[:MOST_RELEASES]) < fine
    assert fallen[MOST_RELEASES:] == [fine] * MOST_RELEASES


@pytest.mark.parametrize(("sunk_mm", "rate"), [(4.0, PACES[1].rate), (2.0, PACES[0].rate)])
def test_what_coarse_parts_let_into_the_table_too_deep_for_exact_rest_falls_once_more_as_finer_ones(
    monkeypatch, sunk_mm, rate
):
    """Exact rest is said to end so deep in the table once; less deep it is released from there."""
    held, walled = [], tray()

    def sinks(drop, placement, poses):
        held.append(poses)
        if len(held) > 1:
            return hold(drop, placement, poses)
        return Rested((translation(0.0, 0.0, -sunk_mm / 1e3) @ poses[0],), False, 0)

    monkeypatch.setattr(settle, "hold", sinks)
    seen = told_by(monkeypatch, lambda outcome: dataclasses.replace(outcome, rise=0.0))
    starts = [put(CUBE, walled, 0.01, (0.05, 0.02), turn(Y, 44.0))]
    settle_group(starts, walled, PHYSICS)
    assert [steps.base_hz for steps, _ in seen] == [PACES[0].rate * PHYSICS.step_hz, rate * PHYSICS.step_hz]


def test_a_single_object_is_not_drawn_again_once_its_falls_have_taken_their_steps(monkeypatch):
    drawn = []

    def draw(start, attempt, others):
        drawn.append(attempt)
        return start

    for most, expected in ((math.inf, 3), (1.0, 0)):
        drawn.clear()
        monkeypatch.setattr(settle, "LOST_STEPS", most)
        with pytest.raises(SettleError, match="off the table's top"):
            settle_scene(
                scene_of([over_edge(0.6).start], TABLE), PHYSICS, EffectPlan(ALL, {}), Pouring(draw=draw, most=3)
            )
        assert len(drawn) == expected


# ---------------------------------------------------------------------------------------------- let go again


@pytest.mark.minute
def test_a_cube_beside_a_wall_that_is_let_go_again_keeps_all_four_of_its_corners_on_the_floor():
    """Bullet keeps four contacts of two bodies, chosen for their area, up to millimetres away; those of a wall count."""
    walled, aside = tray(), turn(Z, 0.0785)
    wall_m = 0.025 * (math.cos(math.radians(0.0785)) + math.sin(math.radians(0.0785))) - 0.15
    for gap_m in (0.0001, 0.0002, 0.00046):
        beside = put(cube(0.05), walled, 0.0, (0.1187, wall_m + gap_m), aside)
        starts = together(walled, [beside, put(cube(0.05), walled, 0.0, (0.118, -0.06))]).starts
        motions = recheck_group(starts, settle_group(starts, walled, PHYSICS), walled, PHYSICS)
        assert max(mm for mm, _ in motions) < 0.01
        assert max(degrees for _, degrees in motions) < 0.001


def test_what_is_let_go_again_is_watched_to_the_end_however_still_it_stands(monkeypatch):
    start = at(asset_of(box(0.1, 0.08, 0.2)), TABLE, (0.0, 0.0, 0.11))
    rest = settle_single(start, TABLE, PHYSICS)
    seen = told_by(monkeypatch)
    recheck(start, rest, TABLE, PHYSICS)
    release_again(scene_of([start], TABLE), [rest], PHYSICS, EffectPlan(("dynamics", "fine_step"), {}), 0.5, FINEST)
    assert [outcome.seconds for _, outcome in seen] == pytest.approx([RECHECK_S, 0.5], abs=1e-3)


def test_what_is_let_go_again_shows_whether_it_rested():
    """A cube of 60 mm on a top that ends at 0.7 m; what tips is stopped once its centre of mass went 0.2 mm."""
    rest = settle_single(at(CUBE, TABLE, (0.0, 0.0, 0.03)), TABLE, PHYSICS)
    for x_m, up_m, least_mm, most_mm in (
        (0.0, 0.0, 0.0, 1e-3),
        (0.0, 1.5e-4, 0.14, 0.16),  # lifted
        (0.699, 0.0, 0.0, 1e-3),  # 1 mm inside an overhang
        (0.701, 0.0, 0.2, 0.5),  # 1 mm outside
    ):
        start = at(CUBE, TABLE, (x_m, 0.0, 0.03 + up_m))
        for rate in (RELEASE_RATE, FINEST):
            moved = dataclasses.replace(rest, T_world_obj=start.T_world_obj)
            moved_mm, _ = recheck(start, moved, TABLE, PHYSICS, rate)
            assert least_mm <= moved_mm <= most_mm, (x_m, up_m, rate)


HELD_M = HELD[0][2]


def released(starts: Sequence[ObjectStart], on: Table, physics=PHYSICS) -> tuple[Drop, Placement]:
    placement = place(starts, [one.T_world_obj for one in starts], forms_of(starts), on, physics)
    return Drop(tuple(starts), on, physics, EffectPlan(("dynamics", "fine_step", "object_contacts"), {})), placement


@pytest.mark.parametrize("slips", [0, 1, MOST_HOLDS - 1, MOST_HOLDS])
def test_what_slips_comes_to_rest_where_it_went_until_it_stays(slips, monkeypatch):
    """The upper of two cubes slips by twice the bound along x, so many times; it is let go from there the next time."""
    starts = together(TABLE, [put(cube(0.05), TABLE, 0.0), put(cube(0.04), TABLE, 0.05)]).starts
    left, seen = [slips], []

    def slip(_drop, _placement, poses, *_):
        seen.append(poses[1][0, 3])
        left[0] -= 1
        by_m = 2.0 * HELD_M if left[0] >= 0 else 0.5 * HELD_M
        return (poses[0], translation(by_m, 0.0, 0.0) @ poses[1]), False

    monkeypatch.setattr(holding, "let_go", slip)
    held = hold(*released(starts, TABLE), [one.T_world_obj for one in starts])
    assert held.still == (slips < MOST_HOLDS)
    assert held.poses[1][0, 3] == pytest.approx(2.0 * HELD_M * slips, abs=1e-9)
    assert seen == pytest.approx([2.0 * HELD_M * k for k in range(min(slips + 1, MOST_HOLDS))], abs=1e-9)


def test_what_leaves_the_table_is_drawn_again_above_the_others_or_removed_or_the_scene_fails():
    """The second of three, a larger cube, begins beyond the edge, then there again, and the third time above the first."""
    starts = together(
        TABLE, [at(CUBE, TABLE, (0.0, 0.0, 0.031)), over_edge(0.6).start, at(CUBE, TABLE, (0.2, 0, 0.04))]
    ).starts
    drawn = []

    def draw(start, attempt, others):
        drawn.append((start.region_id, attempt, [points[:, 2].max() - TOP for points in others]))
        place = over_edge(0.6).start.T_world_obj if attempt == 1 else at(CUBE, TABLE, (0.0, 0.0, 0.2)).T_world_obj
        return dataclasses.replace(start, T_world_obj=place, redraws=start.redraws + 1)

    def settled(**how):
        return settle_scene(scene_of(starts, TABLE), PHYSICS, EffectPlan(ALL, {}), Pouring(**how))

    redrawn = settled(draw=draw, most=3)
    assert [(region, attempt) for region, attempt, _ in drawn] == [(4, 1), (4, 2)]
    assert all(tops == pytest.approx([0.06, 0.06], abs=1e-4) for _, _, tops in drawn)
    assert [start.redraws for start in redrawn.starts] == [0, 2, 0]
    heights = [rest.T_world_obj[2, 3] - TOP for rest in redrawn.settled]
    assert heights == pytest.approx([0.03, 0.11, 0.03], abs=1e-5)
    fewer = settled(remove=True)
    assert [start.region_id for start in fewer.starts] == [3, 4] and "lost_removed" in fewer.called
    assert {contact.with_region for rest in fewer.settled for contact in rest.contacts} == {2}
    with pytest.raises(SettleError, match=r"of region 4 was at \(0\.\d+, 0\.000, -0\.\d+\) m, off the table's top"):
        settled()
    with pytest.raises(SettleError, match="of region 4 had left the table's top"):  # its pose is where it was put away
        settled(draw=draw, most=1)


def test_what_finds_no_balance_is_removed_where_what_leaves_is(monkeypatch):
    """Of three the second is said to slip by 1 mm as often as it is let go among them."""
    starts = together(TABLE, [at(CUBE, TABLE, (x, 0.0, 0.031), LEANS) for x in (0.0, 0.08, 0.16)]).starts
    usual = settle.hold

    def slips(drop, placement, poses):
        if len(poses) < 3:
            return usual(drop, placement, poses)
        return Rested((poses[0], translation(0.001, 0.0, 0.0) @ poses[1], poses[2]), False, 0)

    monkeypatch.setattr(settle, "hold", slips)
    rest = settle_scene(scene_of(starts, TABLE), PHYSICS, EffectPlan(ALL, {}), Pouring(remove=True))
    assert [round(float(start.T_world_obj[0, 3]), 2) for start in rest.starts] == [0.0, 0.16]
    assert [start.region_id for start in rest.starts] == [3, 4] and "lost_removed" in rest.called
    with pytest.raises(SettleError, match="without end"):
        settle_scene(scene_of(starts, TABLE), PHYSICS, EffectPlan(ALL, {}))


@pytest.mark.minute
@pytest.mark.parametrize("pouring", [NOTHING_MORE, Pouring(remove=True)])
@pytest.mark.parametrize("push_m_s", [(40.0, 0.0, 0.0), (0.0, 0.0, 10.0)])
def test_what_was_thrown_is_told_so_and_never_rests_nor_counts_as_lost(push_m_s, pouring, monkeypatch):
    """Whatever throws the second of two, here a push as its fall begins; upwards it comes down on the table again."""
    starts = together(TABLE, [at(CUBE, TABLE, (0.0, 0.0, 0.031), LEANS), at(CUBE, TABLE, (0.2, 0, 0.04))]).starts
    set_velocity = World.set_velocity

    def pushed(world, velocity, spin=(0.0, 0.0, 0.0), body=0):
        set_velocity(world, push_m_s if body == 1 and velocity[2] else velocity, spin, body)

    monkeypatch.setattr(World, "set_velocity", pushed)
    with pytest.raises(SettleError, match=r"flew off at (4[0-9]|10) m/s, which no fall gives") as refused:
        settle_scene(scene_of(starts, TABLE), PHYSICS, EffectPlan(ALL, {}), pouring)
    assert refused.value.reason == "thrown"


def test_a_pile_of_more_than_eight_falls_in_waves_above_what_lies(monkeypatch):
    """Nine cubes in a column of 0.9 m: five fall, then four, which begin 40 mm above what lies and above one another."""
    starts = together(TABLE, [at(CUBE, TABLE, (0.03 * (k % 3), 0.0, 0.07 + 0.1 * k)) for k in range(9)]).starts
    waves, usual = [], release

    def noted(drop, flat, paces):
        waves.append([points_of(start)[:, 2] for start in drop.starts])
        return usual(drop, flat, paces)

    monkeypatch.setattr(settle, "release", noted)
    rest = settle_scene(scene_of(starts, TABLE), PHYSICS, EffectPlan(ALL, {}), Pouring(waves=True))
    assert len(rest.settled) == 9 and [len(wave) for wave in waves[:2]] == [5, 9]
    for wave, lying in zip(waves[:2], (0, 5), strict=True):
        tops = np.maximum.accumulate([TOP, *(heights.max() for heights in wave)])[lying:]
        assert [heights.min() for heights in wave[lying:]] == pytest.approx(tops[:-1] + 0.04, abs=1e-9)


@pytest.mark.parametrize(("bodies", "most"), [(("bowl", "bowl"), 100), (("mug", "box"), 1000)])
def test_only_thin_walls_that_may_lie_in_one_another_fall_as_coarser_parts(bodies, most, monkeypatch):
    """A bowl has a thousand parts, each compared with all of the other's; a mug has four hundred, a box three."""
    given, usual = [], releasing.fall

    def noted(things, *more):
        given.append([len(thing.parts) for thing in things])
        return usual(things, *more)

    monkeypatch.setattr(releasing, "fall", noted)
    starts = [at(built_in(name), TABLE, (0.0, 0.0, 0.2 + 0.3 * k), LEANS) for k, name in enumerate(bodies)]
    settle_group(together(TABLE, starts).starts, TABLE, PHYSICS)
    assert given and all(most / 10 < max(counts) < most for counts in given)


@pytest.mark.minute
def test_six_cups_come_to_rest_one_after_the_other_and_only_neighbours_are_compared_when_let_go(monkeypatch):
    """A cup's wall is in the box of each cup within its height, and touches those of the next alone. Here they stay."""
    apart = []

    def stayed(bodies, poses, *more, **named):
        apart.append(set(more[4].apart))
        return Outcome(tuple(poses), 0.0, 0.0, True)

    monkeypatch.setattr(holding, "fall", stayed)
    group = cups(6)
    settle_group(group.starts, group.table, PHYSICS)
    assert apart == [{(i, j) for j in range(6) for i in range(j - 1)}]


@pytest.mark.minute
def test_letting_go_ends_at_its_budget_and_names_the_objects(monkeypatch):
    monkeypatch.setattr(settle, "LET_GO_COST", 0.0)
    group = cups(2)
    with pytest.raises(SettleError, match=r"regions 3 \(\w+\), 4 \(\w+\) touch with \d+ faces.*coarser meshes"):
        settle_group(group.starts, group.table, PHYSICS)


def test_a_mesh_far_from_its_origin_is_refused_by_name_and_not_as_off_the_table():
    far = box(0.05, 0.05, 0.05)
    far.apply_translation([1e9, 0.0, 0.0])
    with pytest.raises(SettleError, match=r"region 3 .* lies 1e\+09 m from its origin, .*: move the mesh"):
        settle_group([drop(asset_of(far), TABLE, 0.01).start], TABLE, PHYSICS)

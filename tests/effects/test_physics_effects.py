"""Effects of physics: what needs one breaks a tolerance without it; what does not need it, forcing it leaves unchanged."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from schemas.errors import SettleError
from schemas.scene.scene import ObjectStart
from tests.effects.physics_cases import PHYSICS
from tests.effects.physics_scenes import drop_on, facts_with, is_still, moved_from, moved_when_forced, settled
from tests.effects.scenes import Setting, facts_of
from tests.hard_cases.bodies import built_in, cube, mug_on_peg, over_edge, rod
from tests.hard_cases.drops import EDGE_M, X, Y, drop, level, lowered, ring, turn
from tests.hard_cases.measures import Z
from tests.kit.shapes import asset_of
from tests.physics.settling import settle_single
from workers.geometry.frames import transform
from workers.physics.placement import Form, find_gaps_m
from workers.scene.effects import PHYSICS_EFFECTS, Facts, plan_effects

pytestmark = pytest.mark.minute

GAP_MM = 0.1
"""The most that may be between a resting object and what it rests on, or that they may overlap."""


def _com(start: ObjectStart, T):
    return transform(T, start.asset.mass.com[None, :])[0]


def _stack() -> Facts:
    """Two cubes of 0.1 m, one 5 mm above the other, which is 5 mm above the table."""
    return facts_with(drop(cube(), level()), drop(cube(), level(), 0.11))


def _rod_near_the_edge() -> Facts:
    """A rod 0.3 m long that leans towards the table's edge, which is 0.2 m away: it falls across it."""
    return facts_with(drop(rod(0.01, 0.3), level(), 0.0002, turn(Y, 5) @ turn(Z, 1), (EDGE_M - 0.2, 0.0)))


def _on_a_ring_from_1_m() -> Facts:
    """It leans, so that it falls in the simulator: what comes down on a face stands where it lands."""
    return facts_with(drop(cube(0.005), ring(0.001), 1.0, turn(X, 20), (0.45, 0.0)))


# ------------------------------------------------------------------------------------------- where it is needed


def test_without_dynamics_an_object_hangs_in_the_air_by_its_clearance():
    facts = facts_with(drop(built_in("mug"), level(), 0.005))
    (start,) = facts.plan.objects
    forms = [Form(start.asset.shape.mesh), Form(facts.plan.table.mesh)]
    air_mm = find_gaps_m(forms, [start.T_world_obj, np.eye(4)])[0] * 1e3
    assert air_mm == pytest.approx(5.0, abs=1e-6)
    assert air_mm > 10 * GAP_MM
    assert settled(facts).settled[0].hover_gap_mm <= GAP_MM
    with pytest.raises(SettleError, match="unsupported"):
        settled(facts, plan_effects(facts).without("dynamics"))


def test_without_the_tables_mesh_a_box_stands_on_air_beyond_the_edge():
    """With 60 % of it over the edge it cannot stand; on the level without end that stands for a flat top it does."""
    case = over_edge(0.6)
    on_slab, on_mesh = drop_on(case, slab=True), drop_on(case, slab=False)
    standing = _com(case.start, on_slab.poses[0])
    assert on_slab.rested
    assert standing[0] == pytest.approx(EDGE_M + 0.01, abs=1e-3)
    assert standing[2] == pytest.approx(case.table.top.height_m + 0.05, abs=1e-4)
    assert on_mesh.stopped_by == "below" and _com(case.start, on_mesh.poses[0])[2] < case.table.top.height_m - 0.2


def test_the_plan_calls_for_the_mesh_beyond_the_edge_and_settling_does_where_a_rod_falls_across_it():
    assert plan_effects(facts_with(over_edge(0.4))).runs("table_mesh")
    facts = _rod_near_the_edge()
    assert not plan_effects(facts).runs("table_mesh")
    rest = settled(facts)
    reach = transform(rest.settled[0].T_world_obj, facts.plan.objects[0].hull.vertices)[:, 0].max()
    assert reach > EDGE_M + 0.05
    assert rest.called.keys() == {"table_mesh"}
    assert rest.settled[0].support == "mesh"


def test_without_object_contacts_the_cubes_of_a_stack_overlap_by_their_size():
    facts = _stack()
    plan, physics, effects = facts.plan, facts.job.physics, plan_effects(facts)
    assert effects.runs("object_contacts")
    alone = effects.without("object_contacts").ran
    through = [settle_single(start, plan.table, physics, alone).T_world_obj for start in plan.objects]
    stacked = [rest.T_world_obj for rest in settled(facts).settled]
    forms = [*(Form(start.asset.shape.mesh) for start in plan.objects), Form(plan.table.mesh)]
    gaps = [find_gaps_m(forms, [*poses, np.eye(4)]) for poses in (through, stacked)]
    assert min(gaps[0]) < -0.09
    assert np.abs(gaps[1]).max() * 1e3 <= GAP_MM


def test_contacts_that_the_plan_left_out_are_called_for_once_an_object_leaves_its_room():
    facts = _stack()
    rest = settled(facts, plan_effects(facts).without("object_contacts"))
    assert "object_contacts" in rest.called
    heights = [_com(start, one.T_world_obj)[2] for start, one in zip(facts.plan.objects, rest.settled, strict=True)]
    assert heights[1] - heights[0] == pytest.approx(0.1, abs=2e-4)


def test_without_decomposition_a_mug_cannot_hang_by_its_handle():
    """As its hull, which fills the handle, it starts within the peg, and is thrown off it."""
    facts = facts_with(mug_on_peg())
    effects = plan_effects(facts)
    assert effects.runs("decomposition")
    (hanging,) = settled(facts).settled
    T = hanging.T_world_obj
    assert _com(facts.plan.objects[0], T)[2] < facts.plan.table.top.height_m
    assert max(hanging.hover_gap_mm, hanging.penetration_mm) <= GAP_MM
    with pytest.raises(SettleError) as caught:
        settled(facts, effects.without("decomposition"))
    assert caught.value.reason == "left_table"


def test_without_fine_steps_what_is_small_falls_through_a_thin_table():
    """At 960 Hz a cube of 5 mm goes 4.6 mm in a step after 1 m, and the ring is 1 mm thick."""
    facts = _on_a_ring_from_1_m()
    effects = plan_effects(facts)
    assert effects.runs("fine_step")
    (standing,) = settled(facts).settled
    assert _com(facts.plan.objects[0], standing.T_world_obj)[2] == pytest.approx(
        facts.plan.table.top.height_m + 0.0025, abs=1e-4
    )
    with pytest.raises(SettleError) as caught:
        settled(facts, effects.without("fine_step"))
    assert caught.value.reason in ("left_table", "not_at_rest")


@pytest.mark.parametrize(
    "start",
    [
        pytest.param(partial(drop, built_in("bottle"), level(), R=turn(X, 60) @ turn(Y, 20)), id="bottle"),
        pytest.param(partial(drop, rod(0.033, 0.12, 360), level(), R=turn(X, 60) @ turn(Y, 20)), id="can"),
    ],
)
def test_without_rolling_friction_what_is_dropped_on_its_side_rolls_on_past_the_time(start):
    facts = facts_with(start())
    hurried = facts.job.physics.model_copy(update={"max_settle_s": 1.5})
    facts = replace(facts, job=facts.job.model_copy(update={"physics": hurried}))
    effects = plan_effects(facts)
    assert effects.runs("rolling_friction")
    assert settled(facts).settled[0].settle_s < facts.job.physics.max_settle_s
    with pytest.raises(SettleError, match="not_at_rest"):
        settled(facts, effects.without("rolling_friction"))


# ------------------------------------------------------------------------------------------- where it is not

SIDE_BY_SIDE = (("mug", -0.3), ("can", 0.3))

SPARED = {
    **{
        f"{name}, scene {number}": (name, partial(facts_of, replace(case.spares, scene_id=number)))
        for name, case in PHYSICS.items()
        for number in range(3)
    },
    "object_contacts, two far apart": (
        "object_contacts",
        lambda: facts_with(*(drop(built_in(c), level(), xy=(0.0, y)) for c, y in SIDE_BY_SIDE)),
    ),
    "decomposition, a cube on a ring": ("decomposition", lambda: facts_with(drop(cube(), ring(), xy=(0.45, 0.0)))),
    "decomposition, a bowl upside down": (
        "decomposition",
        lambda: facts_with(drop(built_in("bowl"), level(), R=turn(X, 180))),
    ),
    "rolling_friction, a cube": ("rolling_friction", lambda: facts_with(drop(cube(), level()))),
    "table_mesh, a laptop upside down": (
        "table_mesh",
        lambda: facts_with(drop(built_in("laptop"), level(), R=turn(X, 180))),
    ),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * name.endswith(("scene 1", "scene 2"))) for name in SPARED]
)
def test_what_came_to_rest_without_an_effect_stays_where_it_is_under_it(name):
    """Released for a second: within 0.05 mm and 0.01 degrees."""
    effect, facts = SPARED[name][0], SPARED[name][1]()
    assert effect in plan_effects(facts).skipped
    moved = moved_when_forced(facts, effect)
    assert is_still(moved), f"{moved[0]:.4f} mm, {moved[1]:.5f} degrees"


@pytest.mark.parametrize(
    ("effect", "case"),
    [
        ("dynamics", partial(drop, cube(), level())),
        ("table_mesh", lambda: lowered(over_edge(0.6), 0.005)),
        ("decomposition", mug_on_peg),
    ],
)
def test_what_an_effect_is_needed_for_does_not_stay_under_it(effect, case):
    """The same measure of poses that lack it: 5 mm of air, 60 % over the edge, a hull that is not held by its handle."""
    facts = facts_with(case())
    poses = [start.T_world_obj for start in facts.plan.objects]
    assert not is_still(moved_from(facts, poses, plan_effects(facts, frozenset({effect}))))


def test_all_approximations_at_once_leave_a_default_scene_where_it_is():
    names = [effect.name for effect in PHYSICS_EFFECTS if effect.kind == "approximation"]
    assert set(names) == PHYSICS.keys()
    for number in range(3):
        facts = facts_of(Setting({"categories": ["mug", "box", "bottle"]}, scene_id=number))
        assert is_still(moved_when_forced(facts, *names))


def test_the_hull_of_a_laptop_at_rest_stays_on_the_tables_mesh():
    """As one convex body, by the plan that every convex body on a mesh has."""
    facts = facts_of(Setting({"categories": ["laptop"], "start": {"pose": "tumbled"}}, scene_id=1))
    (start,) = facts.plan.objects
    whole = asset_of(trimesh.convex.convex_hull(start.asset.shape.vertices))
    hull = replace(start, asset=replace(whole, mass=start.asset.mass))
    facts = replace(facts, plan=replace(facts.plan, objects=(hull,)))
    assert moved_when_forced(facts, "table_mesh")[0] <= 1.0


def test_a_jar_on_its_side_stays_under_the_tables_mesh_within_the_bounds():
    """As its hull alone."""
    facts = facts_with(drop(built_in("jar"), level(), R=turn(X, 90)))
    assert is_still(moved_when_forced(facts, "table_mesh"))

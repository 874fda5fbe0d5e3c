"""The plan's choices on random scenes: cameras, tiers, textures and shapes of all kinds."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from schemas.errors import SceneError
from schemas.job.assets import CATEGORIES
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FLOOR, REGION_TABLE
from schemas.scene.view import Camera
from tests.effects.cases import NO_OPS, OF_OTHERS
from tests.effects.physics_cases import PHYSICS
from tests.effects.random_physics import needed, random_physics
from tests.effects.scenes import Setting, facts_of, make, with_holes, without_textures
from workers.geometry.raycast import cast_view
from workers.physics.settle import settle_scene
from workers.scene.cameras import place_beside, place_mirror_camera
from workers.scene.effects import EFFECTS, Facts, names_of_kind, plan_effects

pytestmark = pytest.mark.minute

SCENES = 200

KNOWN_MISSES = {(247, "rolling_friction")}
"""A camera whose lens and body have five faces in a row over which it rocks, from 29 degrees beside a lower face: for
`is_round` the lower face is a neighbour, so that the row is none of its own. It begins upright, and rests so."""
EDITS = (lambda plan: plan, lambda plan: plan, with_holes, without_textures)


def random_setting(number: int) -> Setting:
    """Cameras from level to straight down, near and far, wide and narrow, their pictures shifted; every tier but the slow."""
    rng = np.random.default_rng((7, number))
    width, height = 80, 60
    f = float(rng.uniform(40.0, 400.0))
    tilt = float(rng.choice([rng.uniform(0.0, 0.1), rng.uniform(0.1, 1.5)]))
    above_horizon = height + rng.uniform(-3.0, 20.0) + f * np.tan(tilt)
    cy = above_horizon if rng.random() < 0.4 else height / 2
    changes: dict[str, Any] = {
        "categories": [str(rng.choice(CATEGORIES))],
        "render": {"tier": str(rng.choice(["flat", "raster"])), "rgb": bool(rng.random() < 0.8)},
        "sensor": {"depth_noise": {}} if rng.random() < 0.2 else {},
        "start": {"pose": str(rng.choice(["upright", "tumbled", "placed"]))},
        "cameras": {
            "orbit": {"inclination_rad": [tilt, tilt], "radius_m": float(rng.uniform(0.8, 4.0))},
            "sensor": {"width": width, "height": height, "fx": f, "fy": f, "cx": width / 2, "cy": float(cy)},
        },
        "images": {"depth_range_m": [0.2, float(rng.uniform(1.0, 6.0))]},
        "check": {"mirror_agreement_mm": 50.0},
    }
    return Setting(changes, EDITS[int(rng.integers(len(EDITS)))], number)


def cameras_of(facts: Facts) -> Iterator[Camera]:
    """The input camera, those beside it, and mirror cameras from objects at seven distances."""
    first, job = facts.plan.input_cameras[0], facts.job
    yield first
    yield from place_beside(first, job).values()
    for d_z_m in np.linspace(*job.images.depth_range_m, 7):
        yield place_mirror_camera(first, float(d_z_m), job.cameras.mirror)


def may_be_seen(thing: Placed, facts: Facts) -> bool:
    """By rays: whether the thing, alone, is in any of its scene's pictures."""
    return any((cast_view([thing], camera)[1] > 0).any() for camera in cameras_of(facts))


def called_for(facts: Facts) -> set[str]:
    """The no-ops that a scene needs, each found in another way than the plan finds it."""
    plan, job = facts.plan, facts.job
    floor, table = (
        Placed(REGION_FLOOR, plan.floor, np.eye(4)),
        Placed(REGION_TABLE, plan.table.asset.shape, plan.table.T_world_table),
    )
    shapes = (plan.floor, plan.table.asset.shape, plan.objects[0].asset.shape)
    pictures = [p.material.texture for shape in shapes for p in shape.parts if p.uv is not None]
    clear = [
        picture for picture in pictures if picture is not None and picture.shape[2] == 4 and picture[..., 3].min() < 128
    ]
    wanted = {
        "floor": may_be_seen(floor, facts),
        "table": may_be_seen(table, facts),
        "textures": any(picture is not None for picture in pictures) and job.render.rgb,
        "transparency": bool(clear) and job.render.tier == "raster" and job.render.rgb,
        "light_maps": job.render.tier == "raster" and job.render.rgb,
        "exact_agreement": job.sensor.depth_noise is not None,
    }
    return {name for name, wants in wanted.items() if wants}


HALF_OR_ALL = [pytest.param(SCENES // 2, id="100"), pytest.param(SCENES, id="200", marks=pytest.mark.slow)]


@pytest.mark.parametrize("scenes", HALF_OR_ALL)
def test_the_plan_chooses_rightly_on_random_scenes(scenes):
    """Nothing that a scene needs is left out, and what none needs is, but for a few whose pictures pass close by."""
    left_out, idle = Counter[str](), Counter[str]()
    for number in range(scenes):
        try:
            facts = facts_of(random_setting(number))
        except SceneError:
            continue
        plan, wanted = plan_effects(facts), called_for(facts)
        assert {*plan.ran, *plan.skipped} == {effect.name for effect in EFFECTS}.difference(OF_OTHERS)
        for name in names_of_kind("no_op"):
            assert plan.runs(name) or name not in wanted, f"scene {number} needs {name}"
            left_out[name] += not plan.runs(name)
            idle[name] += plan.runs(name) and name not in wanted
    assert all(left_out[name] >= scenes / 25 for name in NO_OPS), left_out
    assert all(idle[name] == 0 for name in NO_OPS if name not in ("floor", "table"))
    assert idle["floor"] <= left_out["floor"] and idle["table"] <= left_out["table"], (idle, left_out)


@pytest.mark.parametrize("scenes", HALF_OR_ALL)
def test_the_plan_chooses_effects_of_physics_rightly_on_random_scenes(scenes):
    """Nothing that a scene needs as it begins is left out; more is only called for where objects come near one another."""
    left_out, idle, seen = Counter[str](), Counter[str](), 0
    for number in range(scenes):
        try:
            facts = facts_of(random_physics(number))
        except SceneError:
            continue
        seen += 1
        plan, wanted = plan_effects(facts), needed(facts, None)
        for name in PHYSICS:
            assert plan.runs(name) or name not in wanted, f"scene {number} needs {name}"
            left_out[name] += not plan.runs(name)
            idle[name] += plan.runs(name) and name not in wanted
    assert seen >= 0.8 * scenes
    assert all(left_out[name] >= scenes / 5 for name in PHYSICS), left_out
    assert idle["dynamics"] == idle["fine_step"] == 0
    assert all(idle[name] <= 0.25 * seen for name in PHYSICS), idle


@pytest.mark.parametrize("wanted", [pytest.param(16, id="16"), pytest.param(SCENES, id="200", marks=pytest.mark.slow)])
def test_what_came_about_while_things_moved_was_called_for_after_all(wanted, record_figure):
    """Settled: what an object swept from its start to where it rests needs nothing that neither plan nor settling names."""
    made, called, missing = 0, Counter[str](), []
    for number in range(4 * wanted):
        try:
            facts = facts_of(random_physics(number))
            plan = plan_effects(facts)
            if plan.runs("decomposition"):
                continue  # cutting takes seconds for each shape, and what is left to be left out is seen above
            rest = settle_scene(facts.plan, facts.job.physics, plan)
        except SceneError:
            continue
        called.update(rest.called.keys())
        lacking = needed(facts, rest.settled) - {*plan.ran, *rest.called}
        missing += [(number, name) for name in sorted(lacking)]
        made += 1
        if made == wanted:
            break
    record_figure(
        f"effects of physics missed in {made} settled random scenes", "one is known", float(len(missing)), 1.0
    )
    assert set(missing) <= KNOWN_MISSES
    assert made == wanted
    assert wanted < SCENES or called["table_mesh"] >= 2, called


@pytest.mark.parametrize("wanted", [pytest.param(8, id="8"), pytest.param(SCENES, id="200", marks=pytest.mark.slow)])
def test_forcing_what_a_random_scene_left_out_changes_no_byte(wanted, record_figure):
    made, forced, changed = 0, Counter[str](), []
    for number in range(4 * wanted):
        setting = random_setting(number)
        try:
            plain = make(setting)
        except SceneError:
            continue
        for name in sorted(names_of_kind("no_op") & plain.scene.effects.skipped.keys()):
            again = make(setting, forced={name})
            forced[name] += 1
            if (plain.files, plain.rows) != (again.files, again.rows):
                changed.append((number, name))
        made += 1
        if made == wanted:
            break
    told = ", ".join(f"{name} {count}" for name, count in sorted(forced.items()))
    record_figure(
        f"no-ops forced in {made} random scenes ({told}): scenes changed", "none may", float(len(changed)), 0.0
    )
    assert changed == []
    assert made == wanted
    assert forced.total() >= 2 * made
    assert wanted < SCENES or all(forced[name] >= 5 for name in NO_OPS)

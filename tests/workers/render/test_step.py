"""Rendering of one view: labels are one in all tiers, colour obeys the plan of effects."""

import numpy as np
import pytest

import workers.render.tiers
from tests.effects.scenes import Setting, facts_of, with_holes
from tests.workers.render.looks import FLAT, FOUR, RASTER, paths, without
from tests.workers.render.pathtraced.scenes import traced
from tests.workers.render.random_scenes import APPEARANCE, camera, orbit_and_mirror, random_things, small
from workers.render.raster.gbuffer import FLAT_EFFECTS
from workers.render.tiers import draw_view
from workers.scene.effects import EFFECTS, plan_effects


@traced
def test_labels_are_the_same_to_the_byte_in_all_tiers(renderer):
    rng = np.random.default_rng(900)
    things, height = random_things(rng)
    view = camera(small(64, 48), orbit_and_mirror(rng, height)[0].T_world_cam)
    drawn = [
        draw_view(renderer, things, APPEARANCE, view, render, lambda: rng, effects)
        for render, effects in (FLAT, RASTER, paths(1))
    ]
    assert len({one.depth_m.tobytes() for one in drawn}) == 1
    assert len({one.region.tobytes() for one in drawn}) == 1
    assert len({one.rgb.tobytes() for one in drawn}) == 3


def test_without_rgb_nothing_is_traced(renderer, monkeypatch):
    monkeypatch.setattr(workers.render.tiers, "shared_tracer", lambda: pytest.fail("a path was traced"))
    rng = np.random.default_rng(900)
    things, height = random_things(rng)
    view = camera(small(64, 48), orbit_and_mirror(rng, height)[0].T_world_cam)
    labels = []
    for look in (FLAT, RASTER, FOUR, paths(1)):
        render, effects = without(look, "rgb")
        seen = draw_view(renderer, things, APPEARANCE, view, render, lambda: rng, effects)
        assert seen.rgb is None
        labels.append((seen.depth_m.tobytes(), seen.region.tobytes()))
    assert len(set(labels)) == 1


@pytest.mark.parametrize("look", [FLAT, RASTER, FOUR, paths(1)], ids=["flat", "raster", "four samples", "path-traced"])
def test_the_plan_of_a_scene_that_calls_for_everything_is_the_look_of_these_tests(look):
    render, effects = look
    facts = facts_of(Setting({"render": render.model_dump()}, with_holes))
    views = {"depth_camera", "mirror"}
    drawn = {effect.name for effect in EFFECTS if effect.stage == "render"} - views
    assert set(effects.ran) == drawn & set(plan_effects(facts).ran)
    assert set(FLAT_EFFECTS.ran) == set(FLAT[1].ran)

"""Passes that are forced do their work and change no byte; passes that are left out are not drawn."""

from collections import Counter
from unittest import mock

import numpy as np
import pytest

import workers.render.raster.gbuffer
from schemas.job.render import Render
from tests.workers.render.random_scenes import APPEARANCE, orbit_and_mirror, procedural_things, random_things
from tests.workers.render.raster.test_raster import FLAT, FOUR, RASTER
from workers.plan.effects import names_of_kind
from workers.render.overrides import Passes
from workers.render.raster.drawing import sort_draws

DRAWN = ("floor", "light_maps", "table", "textures", "transparency")
"""The no-ops that the renderer knows of."""


def forced(name: str) -> Passes:
    return Passes(forced=frozenset({name}))


def left_out(*names: str) -> Passes:
    return Passes(left_out=frozenset(names))


def scenes(count: int):
    """Things and two views each, of 640 x 480 pixels: random shapes, and the built-in ones with their textures."""
    for seed in range(count):
        rng = np.random.default_rng(2_000 + seed)
        things, height = procedural_things(rng) if seed % 2 else random_things(rng)
        yield things, orbit_and_mirror(rng, height)


def test_the_names_are_those_of_effects():
    assert set(DRAWN) == names_of_kind("no_op") - {"exact_agreement"}


@pytest.mark.parametrize("render", [FLAT, RASTER, FOUR], ids=["flat", "raster", "four samples"])
@pytest.mark.parametrize("name", DRAWN)
def test_forcing_a_pass_changes_no_byte(renderer, name, render):
    for things, views in scenes(14):
        for view in views:
            plain = renderer.draw(things, APPEARANCE, view, render)
            again = renderer.draw(things, APPEARANCE, view, render, forced(name))
            for kind in ("rgb", "depth_m", "region"):
                assert getattr(plain, kind).tobytes() == getattr(again, kind).tobytes(), kind


def work(renderer, passes: Passes, render: Render = RASTER) -> Counter[str]:
    """What one view of a scene without textures took: passes, maps, and draws by kind."""
    things, (view, _) = next(scenes(1))
    done = Counter[str]()

    def sort(*args):
        sorted_draws = sort_draws(*args)
        done["passes"] += 1
        for variant, draws in sorted_draws.items():
            done["textured"] += len(draws) * variant.textured
            done["cut out"] += len(draws) * variant.cutout
            done.update(f"region {draw.thing.region_id}" for draw in draws)
        return sorted_draws

    renderer.draw(things[:1], APPEARANCE, view, RASTER)  # the light of another scene
    bakes = renderer._lit().bakes
    with mock.patch.object(workers.render.raster.gbuffer, "sort_draws", sort):
        renderer.draw(things, APPEARANCE, view, render, passes)
    done["maps"] = renderer._lit().bakes - bakes
    return done


def test_a_forced_pass_does_its_work_where_nothing_calls_for_it(renderer):
    plain = work(renderer, Passes())
    assert plain["passes"] == 1
    assert plain["textured"] == plain["cut out"] == 0
    assert work(renderer, forced("transparency"))["passes"] == 3
    both = work(renderer, Passes(forced=frozenset({"transparency", "textures"})))
    assert both["cut out"] > 0
    assert work(renderer, forced("textures"))["textured"] == plain.total() - plain["passes"] - plain["maps"]
    assert work(renderer, Passes(), FLAT)["maps"] == 0
    assert work(renderer, forced("light_maps"), FLAT)["maps"] == 1
    again = work(renderer, Passes(left_out=frozenset({"floor"}), forced=frozenset({"floor"})))
    assert again["region 1"] == plain["region 1"] > 0


def test_a_pass_that_is_left_out_is_not_drawn(renderer):
    plain = work(renderer, Passes())
    assert plain["region 1"] > 0 and plain["region 2"] > 0
    assert work(renderer, left_out("floor"))["region 1"] == 0
    assert work(renderer, left_out("table"))["region 2"] == 0
    assert work(renderer, left_out("floor", "table"))["region 3"] == plain["region 3"] > 0


def test_without_its_maps_a_scene_has_no_shadow_and_no_light_of_another_scene(renderer):
    things, (view, _) = next(scenes(1))
    renderer.draw(things[:2], APPEARANCE, view, RASTER)
    one = renderer.draw(things, APPEARANCE, view, RASTER, left_out("light_maps")).rgb
    renderer.draw(things, APPEARANCE, view, RASTER)
    two = renderer.draw(things, APPEARANCE, view, RASTER, left_out("light_maps")).rgb
    assert np.array_equal(one, two)
    lit = renderer.draw(things, APPEARANCE, view, RASTER).rgb
    assert one.astype(np.int64).sum() > lit.astype(np.int64).sum()

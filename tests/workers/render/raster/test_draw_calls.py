"""Draw calls: exact no-ops that are forced do their work and change no byte; withdrawn ones are not drawn."""

from collections import Counter
from unittest import mock

import numpy as np
import pytest

import workers.render.raster.gbuffer
from tests.workers.render.looks import FLAT, FOUR, RASTER, Look, forcing, without
from tests.workers.render.random_scenes import APPEARANCE, orbit_and_mirror, procedural_things, random_things
from workers.plan.effects import names_of_kind
from workers.render.raster.draw_calls import sort_draws
from workers.render.raster.light_maps import LightMaps

DRAWN = ("floor", "light_maps", "table", "textures", "transparency")
"""The no-ops that the renderer knows of."""


def scenes(count: int):
    """Things and two views each, of 640 x 480 pixels: random shapes, and the built-in ones with their textures."""
    for seed in range(count):
        rng = np.random.default_rng(2_000 + seed)
        things, height = procedural_things(rng) if seed % 2 else random_things(rng)
        yield things, orbit_and_mirror(rng, height)


def test_the_names_are_those_of_effects():
    assert set(DRAWN) == names_of_kind("no_op") - {"exact_agreement"}


@pytest.mark.parametrize("look", [FLAT, RASTER, FOUR], ids=["flat", "raster", "four samples"])
@pytest.mark.parametrize("name", DRAWN)
def test_forcing_a_pass_changes_no_byte(renderer, name, look):
    for things, views in scenes(14):
        for view in views:
            plain = renderer.draw(things, APPEARANCE, view, *look)
            again = renderer.draw(things, APPEARANCE, view, *forcing(look, name))
            for kind in ("rgb", "depth_m", "region"):
                assert getattr(plain, kind).tobytes() == getattr(again, kind).tobytes(), kind


def work(renderer, look: Look) -> Counter[str]:
    """What one view of a scene without textures takes: passes, maps, and draw calls by kind."""
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

    renderer.draw(things[:1], APPEARANCE, view, *RASTER)  # the light of another scene
    with (
        mock.patch.object(workers.render.raster.gbuffer, "sort_draws", sort),
        mock.patch.object(LightMaps, "_bake", autospec=True, side_effect=LightMaps._bake) as bake,
    ):
        renderer.draw(things, APPEARANCE, view, *look)
    done["maps"] = bake.call_count
    return done


def test_a_forced_pass_does_its_work_where_nothing_calls_for_it(renderer):
    plain = work(renderer, RASTER)
    assert plain["passes"] == 1
    assert plain["textured"] == plain["cut out"] == 0
    assert work(renderer, forcing(RASTER, "transparency"))["passes"] == 3
    both = work(renderer, forcing(RASTER, "transparency", "textures"))
    assert both["cut out"] > 0
    assert work(renderer, forcing(RASTER, "textures"))["textured"] == plain.total() - plain["passes"] - plain["maps"]
    assert work(renderer, FLAT)["maps"] == 0
    assert work(renderer, forcing(FLAT, "light_maps"))["maps"] == 1
    again = work(renderer, forcing(without(RASTER, "floor"), "floor"))
    assert again["region 1"] == plain["region 1"] > 0


def test_a_pass_that_is_left_out_is_not_drawn(renderer):
    plain = work(renderer, RASTER)
    assert plain["region 1"] > 0 and plain["region 2"] > 0
    assert work(renderer, without(RASTER, "floor"))["region 1"] == 0
    assert work(renderer, without(RASTER, "table"))["region 2"] == 0
    assert work(renderer, without(RASTER, "floor", "table"))["region 3"] == plain["region 3"] > 0

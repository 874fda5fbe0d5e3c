"""Whether a tier's packages are asked for where they are needed, and what is said without them.

Rendering of one view: labels are one in all tiers, colour obeys the plan of effects.
"""

import importlib.util

import numpy as np
import pytest

import workers.render.pathtraced
from schemas.errors import InputError
from tests.workers.render.looks import FLAT, FOUR, RASTER, paths, traced, without
from tests.workers.render.random_scenes import APPEARANCE, camera, orbit_and_mirror, random_things, small
from workers.render.tiers import draw_view, require_mitsuba


def test_without_mitsuba_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"\./verso extra pathtraced.*render\.tier") as caught:
        require_mitsuba()
    assert caught.value.exit_code == 2


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
    monkeypatch.setattr(workers.render.pathtraced, "shared_tracer", lambda: pytest.fail("a path was traced"))
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

"""Effects of colour: each is drawn because the plan runs it; labels never depend on them, nor on the process."""

import hashlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from schemas.scene.shape import Shape
from tests.workers.render.looks import FLAT, FOUR, RASTER, Look, paths, without
from tests.workers.render.random_scenes import APPEARANCE, orbit_and_mirror, procedural_things, random_things


@pytest.mark.parametrize("render", [RASTER, FOUR])
def test_labels_are_the_flat_tiers_to_the_byte(renderer, render):
    for seed in range(12):
        rng = np.random.default_rng(900 + seed)
        things, height = procedural_things(rng) if seed % 2 else random_things(rng)
        for view in orbit_and_mirror(rng, height):
            flat, raster = (renderer.draw(things, APPEARANCE, view, *one) for one in (FLAT, render))
            assert flat.depth_m.tobytes() == raster.depth_m.tobytes()
            assert flat.region.tobytes() == raster.region.tobytes()
            assert not np.array_equal(flat.rgb, raster.rgb)


WITHDRAWN = [
    *((FLAT, "flat", name) for name in ("rgb", "textures")),
    *((RASTER, "raster", name) for name in ("rgb", "shadows", "ambient_occlusion", "antialiasing", "textures")),
    *((RASTER, "raster", name) for name in ("transparency", "light_maps")),
    *((FOUR, "four samples", name) for name in ("rgb", "antialiasing", "samples")),
]


def with_holes(shape: Shape) -> Shape:
    """The upper half of each texture is clear."""
    parts = []
    for part in shape.parts:
        texture = part.material.texture
        if texture is not None:
            alpha = np.full((*texture.shape[:2], 1), 255, np.uint8)
            alpha[: len(alpha) // 2] = 0
            part = replace(part, material=replace(part.material, texture=np.dstack([texture[..., :3], alpha])))
        parts.append(part)
    return Shape(tuple(parts), shape.closed)


@pytest.mark.parametrize(("look", "tier", "name"), WITHDRAWN, ids=[f"{tier}-{name}" for _, tier, name in WITHDRAWN])
def test_an_effect_that_is_withdrawn_changes_colour_and_no_label(renderer, look: Look, tier: str, name: str):
    changed = False
    for seed in range(4):
        rng = np.random.default_rng(950 + seed)
        things, height = procedural_things(rng)
        things = [replace(thing, shape=with_holes(thing.shape)) for thing in things]
        for view in orbit_and_mirror(rng, height):
            full, less = (renderer.draw(things, APPEARANCE, view, *one) for one in (look, without(look, name)))
            assert full.depth_m.tobytes() == less.depth_m.tobytes()
            assert full.region.tobytes() == less.region.tobytes()
            assert (less.rgb is None) == (name == "rgb")
            changed |= less.rgb is None or not np.array_equal(full.rgb, less.rgb)
    assert changed


def test_the_label_pass_of_the_path_traced_tier_draws_no_colour(renderer):
    rng = np.random.default_rng(31)
    things, height = procedural_things(rng)
    view = orbit_and_mirror(rng, height)[1]
    flat, traced = (renderer.draw(things, APPEARANCE, view, *look) for look in (FLAT, paths(1)))
    assert traced.rgb is None
    assert flat.region.tobytes() == traced.region.tobytes() and flat.depth_m.tobytes() == traced.depth_m.tobytes()


def test_drawing_again_gives_the_same_bytes_also_in_another_process(renderer):
    code = (
        "import hashlib, numpy as np\n"
        "from tests.workers.render.looks import FOUR, RASTER\n"
        "from tests.workers.render.random_scenes import *\n"
        "from workers.render.raster.gbuffer import shared_renderer\n"
        "rng = np.random.default_rng(31)\n"
        "things, height = procedural_things(rng)\n"
        "view = orbit_and_mirror(rng, height)[1]\n"
        "for look in (RASTER, FOUR):\n"
        "    rgb = shared_renderer().draw(things, APPEARANCE, view, *look).rgb\n"
        "    print(hashlib.sha256(rgb.tobytes()).hexdigest())\n"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    rng = np.random.default_rng(31)
    things, height = procedural_things(rng)
    view = orbit_and_mirror(rng, height)[1]
    for _ in range(2):
        mine = ""
        for look in (RASTER, FOUR):
            mine += hashlib.sha256(renderer.draw(things, APPEARANCE, view, *look).rgb.tobytes()).hexdigest() + "\n"
        assert mine == other
        renderer.draw(random_things(np.random.default_rng(5))[0], APPEARANCE, view, *FOUR)

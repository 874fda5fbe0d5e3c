"""The projection and the lights that reach the GPU.

Draw calls: exact no-ops that are forced do their work and change no byte; withdrawn ones are not drawn. Ranks of
regions.
"""

from collections import Counter
from unittest import mock

import numpy as np
import pytest
import trimesh

import workers.render.raster.gbuffer
from schemas.scene.scene import Placed
from schemas.scene.view import Camera, Intrinsics
from tests.kit.shapes import shape_of
from tests.workers.render.looks import FLAT, FOUR, RASTER, Look, forcing, without
from tests.workers.render.random_scenes import APPEARANCE, VGA, orbit_and_mirror, procedural_things, random_things
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import translation
from workers.render.raster.draw_calls import NEAR_M, clip_from_cam, sort_draws
from workers.render.raster.light_maps import LightMaps


def test_the_near_plane_cuts_and_nothing_is_cut_far_away():
    k = Intrinsics(width=4, height=4, fx=1.0, fy=1.0, cx=2.0, cy=2.0)
    for z, inside in ((NEAR_M * 0.999, False), (NEAR_M * 1.001, True), (1.0, True), (1e6, True)):
        clip = clip_from_cam(k) @ [0.0, 0.0, z, 1.0]
        assert (-clip[3] <= clip[2] <= clip[3]) == inside, z


DRAWN = ("floor", "light_maps", "table", "textures", "transparency")
"""The no-ops that the renderer knows of."""

CUBE = shape_of(trimesh.creation.box((0.1, 0.1, 0.1)))


def scenes(count: int):
    """Things and two views each, of 640 x 480 pixels: random shapes, and the built-in ones with their textures."""
    for seed in range(count):
        rng = np.random.default_rng(2_000 + seed)
        things, height = procedural_things(rng) if seed % 2 else random_things(rng)
        yield things, orbit_and_mirror(rng, height)


@pytest.mark.parametrize(
    "look",
    [
        pytest.param(FLAT, id="flat"),
        pytest.param(RASTER, id="raster"),
        pytest.param(FOUR, id="four samples", marks=pytest.mark.minute),
    ],
)
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


def cubes(*spots: tuple[float, float, float], first: int = 3) -> list[Placed]:
    return [Placed(first + k, CUBE, translation(*spot)) for k, spot in enumerate(spots)]


def test_the_twentieth_of_many_is_not_lost_behind_what_it_lies_closely_over(renderer):
    """A plate 0.05 mm above another and seen from 2.5 m hides it, however many others there are."""
    flat = shape_of(trimesh.creation.box((0.3, 0.3, 0.001)))
    far = cubes(*((0.2 * k - 1.0, 1.0, 0.0) for k in range(19)))
    things = [Placed(2, flat, np.eye(4)), *far, Placed(22, flat, translation(0.0, 0.0, 0.00005))]
    camera = Camera(VGA, orbit_pose(np.zeros(3), 0.8, 0.3, 2.5))
    region = renderer.draw(things, APPEARANCE, camera).region
    alone = renderer.draw(things[-1:], APPEARANCE, camera).region
    seen = region[alone == 22]
    assert len(seen) > 2000
    assert (seen == 22).mean() > 0.98  # all but the plate's lower edge

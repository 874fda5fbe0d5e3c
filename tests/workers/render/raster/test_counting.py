"""Pixels that a thing alone would cover, also outside the image."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.scene.scene import Placed
from schemas.scene.view import Camera
from tests.workers.render.random_scenes import (
    APPEARANCE,
    VGA,
    camera,
    object_shape,
    shape_of,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import pose, translation, uniform_rotation
from workers.geometry.raycast import cast_view
from workers.geometry.zbuffer import count_covered


def test_an_unoccluded_thing_in_the_frame_counts_as_many_pixels_as_its_region(renderer):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        thing = Placed(3, object_shape(rng), pose(uniform_rotation(rng), np.array([0.1, -0.05, 1.2])))
        alone = renderer.draw([thing], APPEARANCE, camera())
        assert renderer.count_pixels([thing], camera())[0] == pytest.approx((alone.region == 3).sum(), abs=2)


def test_pixels_outside_the_frame_and_behind_others_are_counted(renderer):
    """A disc pushed over the edges of the image keeps its count, whole pixel by whole pixel."""
    disc = Placed(3, shape_of(trimesh.creation.cylinder(0.2, 0.01, sections=200)), translation(0.0, 0.0, 1.0))
    whole = renderer.count_pixels([disc], camera())[0]
    assert whole == pytest.approx(np.pi * (0.2 * 525 / 0.995) ** 2, rel=2e-3)
    for moved in ({"cx": -50.0}, {"cx": 640.0}, {"cy": 480.0}, {"cx": -100.0, "cy": 570.0}):
        k = VGA.model_copy(update=moved)
        assert renderer.count_pixels([disc], camera(k))[0] == pytest.approx(whole, abs=3)
    assert (
        renderer.draw([disc], APPEARANCE, camera(VGA.model_copy(update={"cx": -100.0, "cy": 570.0}))).region == 3
    ).sum() < whole / 100


def test_a_count_over_several_tiles_is_that_of_a_wider_camera(renderer):
    k, T = small(700, 300), orbit_pose(np.zeros(3), 0.5, 0.3, 0.6)
    thing = Placed(2, shape_of(trimesh.creation.box((0.9, 0.7, 0.02))), np.eye(4))
    wide = k.model_copy(update={"width": 2100, "height": 900, "cx": k.cx + 700, "cy": k.cy + 300})
    assert renderer.count_pixels([thing], Camera(k, T))[0] == pytest.approx(
        (cast_view([thing], Camera(wide, T))[1] == 2).sum(), abs=3
    )


def test_of_a_thing_that_reaches_behind_the_camera_the_part_in_front_is_counted(renderer):
    k = small(60, 40)
    wide = k.model_copy(update={"width": 180, "height": 120, "cx": k.cx + 60, "cy": k.cy + 40})
    # No edge runs through pixel centres, of which a GPU's rounding may give a few to either side.
    rod = Placed(2, shape_of(trimesh.creation.box((0.1, 0.1, 4.0))), translation(0.3037, 0.2011, 1.0))
    behind = Placed(2, rod.shape, translation(0.0, 0.0, -5.0))
    assert renderer.count_pixels([rod], camera(k))[0] == pytest.approx(
        (cast_view([rod], camera(wide))[1] == 2).sum(), abs=2
    )
    assert renderer.count_pixels([behind], camera(k))[0] == 0


def test_counts_that_follow_one_another_share_no_pixels(renderer):
    """More of them than the stencil has numbers, so that it is cleared in between."""
    disc = Placed(3, shape_of(trimesh.creation.cylinder(0.02, 0.01)), translation(0.0, 0.0, 1.0))
    first = renderer.count_pixels([disc], camera())[0]
    assert first > 0
    assert {renderer.count_pixels([disc], camera())[0] for _ in range(600)} == {first}


def test_things_that_are_counted_together_count_as_each_alone(renderer):
    """One of them covers several tiles, one lies behind the camera."""
    shape = shape_of(trimesh.creation.cylinder(0.2, 0.01))
    things = [Placed(n, shape, translation(0.05 * n, 0.0, z)) for n, z in ((2, 1.0), (3, 0.06), (4, -1.0), (5, 0.8))]
    together = renderer.count_pixels(things, camera())
    assert together == [renderer.count_pixels([thing], camera())[0] for thing in things]
    assert together[0] > 0 and together[1] > together[3] > together[0] and together[2] == 0


def test_the_processor_counts_the_same_pixels(renderer):
    """To the pixel where the driver is llvmpipe on a processor with FMA; other drivers may move a corner by 1/256 pixel."""
    rng, off = np.random.default_rng(5), []
    for _ in range(60):
        shape = object_shape(rng)
        for one in (shape, replace(shape, closed=not shape.closed)) if shape.closed else (shape,):
            T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.6, 2.0)]))
            off.append(abs(count_covered(one, T, VGA) - renderer.count_pixels([Placed(3, one, T)], camera())[0]))
    assert max(off) <= 2
    assert np.mean(np.array(off) == 0) > 0.9

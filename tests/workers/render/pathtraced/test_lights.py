"""Lights of the path tracer, against formulas."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light
from tests.workers.render.looks import BLACK, paths
from tests.workers.render.pathtraced.scenes import matte, traced, with_material
from tests.workers.render.random_scenes import (
    EYE,
    camera,
    facing,
    floor,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.render.pathtraced import lamp_directions, sky_directions, sky_picture


@traced
@pytest.mark.parametrize("angle", [0.0, 0.5, 1.0])
def test_a_lit_plane_is_as_bright_as_lambert_says(tracer, angle):
    """albedo x irradiance / pi, that is albedo x color x cosine, to 2 %: lamps and glow together."""
    light = Light(frozen_array([np.sin(angle), 0.0, np.cos(angle)]), (0.9, 0.8, 0.7))
    ground = Placed(1, with_material(floor().shape, matte(0.5)), EYE)
    view = camera(small(24, 24), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    seen = tracer.radiance([ground], Appearance(BLACK, (light,), BLACK), view, *paths(16), 0)[8:16, 8:16].mean((0, 1))
    assert seen == pytest.approx(0.5 * np.cos(angle) * np.array(light.color), rel=0.02)


@traced
def test_a_plane_under_an_open_sky_sees_the_ambient_light_whatever_the_skys_gradient(tracer):
    ambient = (0.4, 0.5, 0.6)
    ground = Placed(1, with_material(floor().shape, matte(0.5)), EYE)
    view = camera(small(24, 24), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    seen = tracer.radiance([ground], Appearance(ambient, (), BLACK), view, *paths(16), 0)[8:16, 8:16].mean((0, 1))
    assert seen == pytest.approx(0.5 * np.array(ambient), rel=0.02)


@traced
def test_light_that_comes_from_one_side_comes_from_that_side(tracer):
    """A fill light from +x in the sky's picture brightens the face that looks to +x, as much as Lambert says."""
    fill = Light(frozen_array([0.8, 0.0, 0.6]), (0.5, 0.5, 0.5))
    none = Light(frozen_array([0.0, 0.0, 1.0]), BLACK)
    for yaw, towards in ((0.0, [1.0, 0.0]), (0.5 * np.pi, [0.0, 1.0]), (np.pi, [-1.0, 0.0])):
        T = np.eye(4)
        T[:3, :3] = np.array([[0.0, -towards[1], towards[0]], [0.0, towards[0], towards[1]], [-1.0, 0.0, 0.0]])
        wall = Placed(3, with_material(facing(0.0, 1.0), matte(0.5)), T)
        eye = np.eye(4)
        eye[:3, 3] = [3 * towards[0], 3 * towards[1], 0.0]
        eye[:3, :3] = np.array([[-towards[1], 0.0, -towards[0]], [towards[0], 0.0, -towards[1]], [0.0, -1.0, 0.0]])
        look = Appearance(BLACK, (none, fill), BLACK)
        seen = tracer.radiance([wall], look, camera(small(9, 9, fx=60.0, fy=60.0), eye), *paths(64), 0)[3:6, 3:6].mean()
        expected = 0.25 * max(0.8 * towards[0], 0.0)
        assert seen == pytest.approx(expected, rel=0.08, abs=0.03), f"a wall turned by {yaw}"


def test_lamps_lie_evenly_on_the_disc_and_the_sky_is_as_strong_as_the_lights_say():
    towards = np.array([0.48, 0.6, 0.64])
    spread = lamp_directions(towards)
    assert np.linalg.norm(spread.mean(axis=0) - towards) < 2e-3
    assert np.arccos((spread @ towards).min()) == pytest.approx(0.03, rel=0.03)
    directions = sky_directions((np.arange(64) + 0.5) / 64)
    fill = Light(frozen_array([0.6, 0.0, 0.8]), (0.3, 0.3, 0.3))
    picture = sky_picture(Appearance(BLACK, (Light(frozen_array([0.0, 0.0, 1.0]), BLACK), fill), BLACK), directions)[
        ..., 0
    ]
    height, width = picture.shape
    cell = np.sqrt(1.0 - directions[..., 2] ** 2) * (2 * np.pi / width) * (np.pi / height)
    received = (picture * np.maximum(directions @ fill.direction, 0.0) * cell).sum()
    assert received == pytest.approx(0.3 * np.pi, rel=1e-3)
    assert (directions[height // 4, picture[height // 4].argmax()] @ fill.direction) > 0.97

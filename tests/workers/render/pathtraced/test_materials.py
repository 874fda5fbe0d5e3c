"""Materials of the path tracer: textures, glass, holes."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from tests.workers.render.looks import BLACK, FLAT, paths, without
from tests.workers.render.pathtraced.scenes import DOWN, matte, traced, with_material
from tests.workers.render.random_scenes import (
    EYE,
    camera,
    facing,
    floor,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.render.pathtraced import encode_light, tint_of

GLASS = Material((0.7, 0.8, 0.8, 1.0), roughness=0.1, transmission=1.0)
RED = Material((0.9, 0.05, 0.05, 1.0), roughness=1.0)


def through(tracer, material, look=None):
    """Mean linear colour of a red wall with a pane of this material in front of it."""
    wall = Placed(3, with_material(facing(3.0, 9.0), RED), EYE)
    pane = Placed(4, with_material(facing(2.0, 4.0), material), EYE)
    sky = Appearance((0.8, 0.8, 0.8), (), BLACK, (0.8, 0.8, 0.8))
    return tracer.radiance([wall, pane], sky, camera(small(9, 9)), *(look or paths(64)), 0).mean((0, 1))


@traced
def test_a_texture_lies_as_in_the_raster_tier(renderer, tracer):
    colors = np.array([[[220, 30, 30], [30, 220, 30]], [[30, 30, 220], [220, 220, 30]]], np.uint8)
    picture = frozen_array(np.repeat(np.repeat(colors, 32, 0), 32, 1), np.uint8)
    (part,) = facing(2.0, 1.5).parts
    uv = frozen_array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    card = Shape((Part("card", part.vertices, part.faces, Material((1.0, 1.0, 1.0, 1.0), 0.0, 1.0, picture), uv=uv),))
    look = Appearance(
        (0.5, 0.5, 0.5), (Light(frozen_array([0.0, 0.0, -1.0]), (0.5, 0.5, 0.5)),), BLACK, (0.5, 0.5, 0.5)
    )
    view = camera(small(32, 32))
    drawn = renderer.draw([Placed(3, card, EYE)], look, view, *FLAT).rgb
    seen = encode_light(tracer.radiance([Placed(3, card, EYE)], look, view, *paths(16), 0))
    for v, u in ((8, 8), (8, 24), (24, 8), (24, 24)):
        assert (drawn[v, u] > 120).tolist() == (seen[v, u] > 120).tolist(), f"at {u}, {v}"


@traced
def test_a_thing_behind_glass_is_seen_and_behind_anything_else_is_not(tracer):
    red, green = through(tracer, GLASS)[:2]
    assert red > 3.0 * green
    red, green = through(tracer, matte(0.5))[:2]
    assert red == pytest.approx(green, rel=0.05)


@traced
def test_without_the_effect_glass_is_as_opaque_as_anything_else(tracer):
    """The pane has the colour of the same material without transmission, and no red of the wall behind it."""
    opaque = through(tracer, GLASS, without(paths(64), "glass"))
    assert opaque == pytest.approx(through(tracer, replace(GLASS, transmission=0.0)), rel=1e-6)
    red, green = opaque[:2]
    assert red < green


@traced
def test_without_textures_or_transparency_a_card_with_a_hole_is_whole(tracer):
    texture = np.full((8, 8, 4), 255, np.uint8)
    texture[:, :4, 3], texture[..., 1:3] = 0, 60
    (part,) = facing(2.0, 1.0).parts
    uv = frozen_array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    card = Shape((Part("card", part.vertices, part.faces, Material((1.0, 1.0, 1.0, 1.0), 0.0, 1.0, texture), uv=uv),))
    sky, view = Appearance((0.5,) * 3, (), BLACK, (0.5,) * 3), camera(small(32, 32))
    left, right = (slice(12, 20), slice(10, 14)), (slice(12, 20), slice(18, 22))

    def seen(look):
        light = tracer.radiance([Placed(3, card, EYE)], sky, view, *look, 0)
        return light[left].mean((0, 1)), light[right].mean((0, 1))

    hole, red = seen(paths(16))
    assert (hole == 0.0).all() and red[0] > 3.0 * red[1] > 0.0
    whole, red = seen(without(paths(16), "transparency"))
    assert whole == pytest.approx(red, rel=0.02) and red[0] > 3.0 * red[1]
    for half in seen(without(paths(16), "textures")):
        assert half[0] == pytest.approx(half[1]) and half[0] > 0.2


@traced
def test_the_second_side_of_a_wall_changes_nothing(tracer):
    behind = Material((0.7, 0.8, 0.8, 1.0), transmission=1.0, ior=1.0)
    (part,) = facing(3.0, 9.0).parts
    wall = Placed(3, with_material(facing(3.0, 9.0), RED), EYE)
    look = Appearance((0.8, 0.8, 0.8), (), BLACK, (0.8, 0.8, 0.8))
    alone = tracer.radiance([wall], look, camera(small(9, 9)), *paths(64), 0).mean((0, 1))
    assert through(tracer, behind) == pytest.approx(alone, rel=0.02)
    assert part.faces.shape == (2, 3)


@traced
def test_only_the_clear_part_of_a_labelled_glass_lets_light_through(tracer):
    half = np.zeros((8, 8), np.uint8)
    half[:4] = 255
    (part,) = facing(2.0, 4.0).parts
    uv = frozen_array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    paper = Material((0.2, 0.2, 0.9, 1.0), roughness=1.0, transmission=1.0, transmission_map=half)
    pane = Placed(4, Shape((Part("pane", part.vertices, part.faces, paper, uv=uv),)), EYE)
    wall = Placed(3, with_material(facing(3.0, 9.0), RED), EYE)
    look = Appearance((0.8, 0.8, 0.8), (), BLACK, (0.8, 0.8, 0.8))
    seen = tracer.radiance([wall, pane], look, camera(small(16, 16)), *paths(16), 0)
    lower, upper = seen[:6].mean((0, 1)), seen[-6:].mean((0, 1))  # v runs up, and y of this camera down
    assert upper[0] > 2.0 * upper[2]
    assert lower[2] > 2.0 * lower[0]


def test_a_labelled_glass_is_tinted_like_the_same_glass_without_a_label():
    picture = np.full((4, 4, 3), (60, 120, 60), np.uint8)
    picture[:2] = 255
    clear = np.zeros((4, 4), np.uint8)
    clear[2:] = 255
    plain = Part("p", *_square(), Material((60 / 255, 120 / 255, 60 / 255, 1.0), transmission=1.0))
    labelled = Material((1.0, 1.0, 1.0, 1.0), texture=picture, transmission=1.0, transmission_map=clear)
    uv = frozen_array(np.zeros((4, 2)))
    assert tint_of(Part("p", *_square(), labelled, uv=uv)) == pytest.approx(tint_of(plain))
    assert (tint_of(plain) < 0.8).all()


def _square():
    part = facing(1.0).parts[0]
    return part.vertices, part.faces


@traced
def test_the_shadow_of_glass_is_lighter_than_that_of_paper(tracer):
    ground = Placed(1, with_material(floor().shape, matte(0.5)), EYE)
    look = Appearance(BLACK, (DOWN,), BLACK)
    view = camera(small(9, 9, fx=30.0, fy=30.0), orbit_pose(np.zeros(3), 0.5, 0.3, 2.0))

    def shadow(material):
        roof = Placed(3, with_material(facing(2.0, 0.7), material), EYE)
        return tracer.radiance([ground, roof], look, view, *paths(64), 0)[3:6, 3:6].mean()

    lit = tracer.radiance([ground], look, view, *paths(64), 0)[3:6, 3:6].mean()
    assert shadow(matte(0.5)) < 0.3 * lit
    assert 0.6 * lit < shadow(GLASS) < 0.98 * lit

"""Lights of the path tracer, against formulas.

Materials of the path tracer: textures, glass, holes. The path tracer: the camera and its samples, against the label
pass and against counting.
"""

import hashlib
import subprocess
import sys

import cv2
import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Appearance, Light, Material
from tests.workers.render.looks import BLACK, OVERHEAD, matte, paths, traced, with_material, without
from tests.workers.render.random_scenes import (
    APPEARANCE,
    EYE,
    WHITE,
    camera,
    facing,
    floor,
    orbit_and_mirror,
    procedural_things,
    random_things,
    shape_of,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import invert, pose, rotation_about, translation
from workers.render.pathtraced import (
    encode_light,
    lamp_directions,
    sky_directions,
    sky_picture,
)


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


RED = Material((0.9, 0.05, 0.05, 1.0), roughness=1.0)


def through(tracer, material, look=None):
    """Mean linear colour of a red wall with a pane of this material in front of it."""
    wall = Placed(3, with_material(facing(3.0, 9.0), RED), EYE)
    pane = Placed(4, with_material(facing(2.0, 4.0), material), EYE)
    sky = Appearance((0.8, 0.8, 0.8), (), BLACK, (0.8, 0.8, 0.8))
    return tracer.radiance([wall, pane], sky, camera(small(9, 9)), *(look or paths(64)), 0).mean((0, 1))


def cast(tracer, things, appearance, view):
    """(region [H, W], z along the optical axis [H, W]) of Mitsuba's own hits at pixel centres; 0 where nothing is hit."""
    mi, k = tracer._mi, view.intrinsics
    scene, sensor = tracer.build(things, appearance, paths(1)[1]).scene, tracer.sensor(view)
    T_cam_world = invert(view.T_world_cam)
    region, z = np.zeros((k.height, k.width), int), np.zeros((k.height, k.width))
    for v in range(k.height):
        for u in range(k.width):
            at = mi.Point2f((u + 0.5) / k.width, (v + 0.5) / k.height)
            ray, _ = sensor.sample_ray(0.0, 0.5, at, mi.Point2f(0.5, 0.5))
            hit = scene.ray_intersect_preliminary(ray, True)
            if hit.is_valid():
                region[v, u] = int(hit.shape.id().split("-")[1])
                z[v, u] = (T_cam_world[:3, :3] @ np.array(ray(hit.t)) + T_cam_world[:3, 3])[2]
    return region, z


def away_from_edges(region):
    """Pixels whose neighbours are all of one region."""
    image = region.astype(np.uint8)
    return cv2.dilate(image, np.ones((3, 3))) == cv2.erode(image, np.ones((3, 3)))


@traced
def test_mitsuba_sees_the_same_surface_through_every_pixel_at_the_same_depth(renderer, tracer, record_figure):
    """Its own rays through pixel centres against the label pass: regions away from edges, and z, which it does not store.

    The camera is rolled, so that a shift along rows or columns alike moves the floor's depth: by 3 mm for a pixel.
    """
    agree, off_mm, objects = [], [], 0
    for seed in (3, 4, 6):
        rng = np.random.default_rng(700 + seed)
        things, height = procedural_things(rng) if seed % 2 else random_things(rng)
        view = orbit_and_mirror(rng, height)[seed % 2]
        shifted = small(120, 90, fx=131.0, fy=131.0, cx=52.3 + seed, cy=49.7)
        view = camera(shifted, view.T_world_cam @ pose(rotation_about(np.array([0.0, 0.0, 1.0]), 0.7), np.zeros(3)))
        labels = renderer.draw(things, APPEARANCE, view)
        region, z = cast(tracer, things, APPEARANCE, view)
        inside = away_from_edges(labels.region)
        same = region == labels.region
        agree.append(same[inside])
        off_mm.append(1e3 * np.abs(z - labels.depth_m)[inside & same & (region > 0)])
        objects += int((labels.region[inside] >= REGION_FIRST_OBJECT).sum())
    share, median = float(np.concatenate(agree).mean()), float(np.median(np.concatenate(off_mm)))
    record_figure("traced silhouettes: share of pixels off an edge with the label's region", "ok", share, 0.999)
    record_figure("traced depth against the label pass, median mm", "ok", median, 0.05)
    assert objects > 200
    assert share > 0.999
    assert median < 0.05


@traced
@pytest.mark.parametrize("k", [small(60, 44, cx=22.0, cy=27.0), small(60, 44, fx=30.0, fy=41.0, cx=22.0, cy=27.0)])
def test_colour_covers_the_pixels_that_the_mask_covers(renderer, tracer, k):
    """Also where pixels are not square: a white sphere off the axis before a black background."""
    ball = Placed(3, shape_of(trimesh.creation.icosphere(3, 0.5)), translation(0.3, -0.2, 2.0))
    mask = renderer.draw([ball], WHITE, camera(k)).region > 0
    around = Appearance((1.0, 1.0, 1.0), (), BLACK, below=(1.0, 1.0, 1.0))
    light = tracer.radiance([ball], around, camera(k), *paths(4), 0)[..., 1]
    inside = away_from_edges(mask)
    assert mask[inside].any()
    assert ((light > 0.1) == mask)[inside].all()
    assert (light[inside & ~mask] == 0.0).all()


RUN = """
import hashlib, numpy as np
from tests.workers.render.random_scenes import APPEARANCE, camera, orbit_and_mirror, random_things, small
from tests.workers.render.looks import paths
from workers.render.pathtraced import Tracer, encode_light
rng = np.random.default_rng(5)
things, height = random_things(rng)
view = camera(small(96, 72), orbit_and_mirror(rng, height)[1].T_world_cam)
print(hashlib.sha256(encode_light(Tracer().radiance(things, APPEARANCE, view, *paths(4), 77)).tobytes()).hexdigest())
"""


@traced
def test_the_same_seed_gives_the_same_bytes_here_and_in_another_process(tracer):
    rng = np.random.default_rng(5)
    things, height = random_things(rng)
    view = camera(small(96, 72), orbit_and_mirror(rng, height)[1].T_world_cam)

    def digest(seed):
        return hashlib.sha256(
            encode_light(tracer.radiance(things, APPEARANCE, view, *paths(4), seed)).tobytes()
        ).hexdigest()

    first = digest(77)
    tracer._built = None
    assert digest(77) == first != digest(78)
    other = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True)
    assert other.stdout.split()[-1] == first


@traced
def test_sixteen_samples_leave_at_most_half_the_noise_of_four(tracer):
    """Four times the samples halve the noise of independent ones; spread evenly they do better."""
    rng = np.random.default_rng(5)
    things, height = random_things(rng)
    view = camera(small(48, 36), orbit_and_mirror(rng, height)[1].T_world_cam)

    def noise(samples):
        many = [tracer.radiance(things, APPEARANCE, view, *paths(samples), seed) for seed in range(6)]
        return float(np.std(many, axis=0).mean())

    assert noise(16) < 0.55 * noise(4)


@traced
def test_without_global_illumination_light_reaches_only_what_sees_a_lamp(tracer):
    """A ceiling over a lit floor, seen from below: all of its light comes by way of the floor."""
    ceiling = Placed(3, with_material(facing(1.0, 0.5), matte(0.8)), EYE)
    ground = Placed(1, with_material(floor().shape, matte(0.8)), EYE)
    eye = np.eye(4)
    eye[:3, 3] = [0.0, 0.0, 0.2]
    look, view = Appearance(BLACK, (OVERHEAD,), BLACK), camera(small(9, 9, fx=40.0, fy=40.0), eye)

    def seen(thing):
        full, direct = (tracer.radiance([ground, ceiling], look, thing, *one, 0).mean() for one in tiers)
        return full, direct

    tiers = (paths(64), without(paths(64), "global_illumination"))
    full, direct = seen(view)
    assert full > 0.05
    assert direct < 1e-12
    full, direct = seen(camera(small(9, 9, fx=40.0, fy=40.0), orbit_pose(np.array([3.0, 0.0, 0.0]), 0.9, 0.0, 2.0)))
    assert direct == pytest.approx(0.8 * 0.7, rel=0.02), "an open floor has Lambert's brightness"
    assert full == pytest.approx(direct, rel=0.05)

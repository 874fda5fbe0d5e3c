"""The path tracer: the camera and its samples, against the label pass and against counting."""

import hashlib
import subprocess
import sys

import cv2
import numpy as np
import pytest
import trimesh

from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Appearance
from tests.workers.render.looks import BLACK, paths, without
from tests.workers.render.pathtraced.scenes import DOWN, matte, traced, with_material
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
from workers.render.pathtraced import clamp_fireflies, encode_light, round_up_samples, square_pixels


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


def test_the_film_of_square_pixels_holds_the_image_and_is_no_coarser():
    for k in (small(64, 48), small(64, 48, fx=32.0, fy=50.0), small(7, 1, fx=9.0, fy=2.0)):
        width, height, f = square_pixels(k)
        assert width >= k.width and height >= k.height and f == max(k.fx, k.fy)
        assert width - 1 < k.width * f / k.fx <= width + 1e-6


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


def test_specks_are_taken_away_and_lines_and_spots_of_three_pixels_stay():
    light = np.full((9, 9, 3), 0.2)
    light[4, 4] = light[0, 8] = 5.0
    light[1, 1] = light[2, 1] = light[2, 2] = 3.0
    light[7, :] = 0.5
    seen = clamp_fireflies(light)
    specks = np.zeros((9, 9), bool)
    specks[4, 4] = specks[0, 8] = True
    assert seen[specks] == pytest.approx(0.2)
    assert (seen[~specks] == light[~specks]).all()
    assert (clamp_fireflies(np.ones((1, 1, 3))) == 1.0).all()


def test_samples_fill_a_grid_and_are_never_fewer_than_asked():
    for asked in range(1, 300):
        taken = round_up_samples(asked)
        assert asked <= taken < asked + np.sqrt(asked)
        assert any(taken % side == 0 for side in range(int(np.sqrt(asked)), int(np.sqrt(asked)) + 1))
    assert [round_up_samples(n) for n in (1, 2, 4, 13, 16, 64)] == [1, 2, 4, 15, 16, 64]


@traced
def test_without_global_illumination_light_reaches_only_what_sees_a_lamp(tracer):
    """A ceiling over a lit floor, seen from below: all of its light comes by way of the floor."""
    ceiling = Placed(3, with_material(facing(1.0, 0.5), matte(0.8)), EYE)
    ground = Placed(1, with_material(floor().shape, matte(0.8)), EYE)
    eye = np.eye(4)
    eye[:3, 3] = [0.0, 0.0, 0.2]
    look, view = Appearance(BLACK, (DOWN,), BLACK), camera(small(9, 9, fx=40.0, fy=40.0), eye)

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

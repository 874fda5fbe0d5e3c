"""The path tracer: lights and materials against formulas, its camera against the label pass, its bytes, and its tier."""

import hashlib
import importlib.util
import subprocess
import sys

import cv2
import numpy as np
import pytest
import trimesh

import workers.render.pathtraced
from schemas.base import frozen_array
from schemas.errors import InputError
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Appearance, Light, Material
from tests.workers.render.random_scenes import (
    APPEARANCE,
    BLACK,
    EYE,
    FLAT,
    FOUR,
    RASTER,
    WHITE,
    camera,
    facing,
    floor,
    matte,
    orbit_and_mirror,
    paths,
    procedural_things,
    quad,
    random_things,
    shape_of,
    small,
    traced,
    with_material,
    without,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import UP, invert, pose, rotation_about, translation
from workers.render.emitters import WINDOW_LIFT_M, WINDOW_TIMES, lamp_directions, sky_directions, sky_picture
from workers.render.pathtraced import draw_view, encode_light
from workers.render.tiers import require_mitsuba


@traced
def test_a_plane_is_as_bright_as_lambert_says_under_a_lamp_and_under_a_sky(tracer):
    """albedo x irradiance / pi, that is albedo x color x cosine, to 2 %: lamps and glow together, or the ambient light."""
    view, ambient = camera(small(24, 24), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0)), (0.4, 0.5, 0.6)
    ground = Placed(1, with_material(floor().shape, matte(0.5)), EYE)
    looks = [(Appearance(ambient, (), BLACK), ambient)]
    for angle in (0.0, 0.5, 1.0):
        light = Light(frozen_array([np.sin(angle), 0.0, np.cos(angle)]), (0.9, 0.8, 0.7))
        looks.append((Appearance(BLACK, (light,), BLACK), np.cos(angle) * np.array(light.color)))
    for look, expected in looks:
        seen = tracer.radiance([ground], look, view, *paths(16), 0)[8:16, 8:16].mean((0, 1))
        assert seen == pytest.approx(0.5 * np.array(expected), rel=0.02)


def test_lamps_lie_evenly_on_the_disc_and_the_sky_is_as_strong_as_the_lights_say():
    towards = np.array([0.48, 0.6, 0.64])
    spread = lamp_directions(towards)
    assert np.linalg.norm(spread.mean(axis=0) - towards) < 2e-3
    assert np.arccos((spread @ towards).min()) == pytest.approx(0.03, rel=0.03)
    directions = sky_directions((np.arange(64) + 0.5) / 64)
    fill = Light(frozen_array([0.6, 0.0, 0.8]), (0.3, 0.3, 0.3))
    picture = sky_picture(Appearance(BLACK, (Light(frozen_array(UP), BLACK), fill), BLACK), directions)[..., 0]
    height, width = picture.shape
    cell = np.sqrt(1.0 - directions[..., 2] ** 2) * (2 * np.pi / width) * (np.pi / height)
    received = (picture * np.maximum(directions @ fill.direction, 0.0) * cell).sum()
    assert received == pytest.approx(0.3 * np.pi, rel=1e-3)
    assert (directions[height // 4, picture[height // 4].argmax()] @ fill.direction) > 0.97


@traced
def test_a_pane_of_glass_shows_what_is_behind_it_and_none_does_without_the_effect(tracer):
    red = Material((0.9, 0.05, 0.05, 1.0), roughness=1.0)
    wall = Placed(3, with_material(facing(3.0, 9.0), red), EYE)
    pane = Placed(4, with_material(facing(2.0, 4.0), Material((0.9, 0.9, 0.9, 1.0), transmission=1.0)), EYE)
    sky, view = Appearance((0.8, 0.8, 0.8), (), BLACK, (0.8, 0.8, 0.8)), camera(small(9, 9))
    clear, solid = (
        tracer.radiance([wall, pane], sky, view, *look, 0).mean((0, 1))
        for look in (paths(64), without(paths(64), "glass"))
    )
    assert clear[0] > 2.0 * clear[1]
    assert solid[0] == pytest.approx(solid[1], rel=0.05)


def under_a_polygon(corners, point, normal):
    """Irradiance from a polygon [N, 3] of radiance 1, all of it before the surface (Lambert 1760)."""
    towards = (corners - point) / np.linalg.norm(corners - point, axis=1, keepdims=True)
    after = np.roll(towards, -1, axis=0)
    across = np.cross(towards, after)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return 0.5 * abs(np.arccos((towards * after).sum(axis=1)) @ across @ normal)


@traced
@pytest.mark.parametrize("quarters", [0, 3])
def test_a_window_lights_what_faces_it_as_a_rectangle_does_and_is_seen_as_bright_as_it_is(tracer, quarters):
    """Without light that is thrown back, an upright and a level paper; nothing behind a screen; and the sky is not seen."""
    T, level = pose(rotation_about(UP, quarters * np.pi / 2), np.zeros(3)), (0.3, 0.4, 0.5)
    look, radiance = (
        Appearance(BLACK, (Light(frozen_array(UP), level),), (0.1, 0.2, 0.3)),
        4.0 * WINDOW_TIMES * np.array(level),
    )
    panes = [
        Placed(1, with_material(shape_of(trimesh.creation.box(bounds=BOX).apply_transform(T)), material), EYE)
        for material in (Material(), Material((1.0, 1.0, 1.0, 1.0), emission=4.0))
    ]
    lamp, at = np.array([1.98 - WINDOW_LIFT_M, 0.1, 1.0]) + [0.0, 0.7, 0.5] * UPRIGHT, np.array([0.4, 0.1, 0.4])
    screen = [Placed(3, quad(at + [1.0, 0.0, 0.0] + 0.8 * UPRIGHT), T)]
    for paper, normal, between in ((UPRIGHT, [1, 0, 0], []), (LEVEL, [0, 0, 1], []), (UPRIGHT, [1, 0, 0], screen)):
        view = camera(small(12, 12, fx=200.0, fy=200.0), T @ orbit_pose(at, 1.2 * normal[2], 0.3, 0.3))
        things = [Placed(1, quad(at + 0.05 * paper, material=matte(0.5)), T), *between]
        without_it, seen = (
            tracer.radiance([*things, pane], look, view, *without(paths(64), "global_illumination"), 0)
            for pane in panes
        )
        expected = 0.0 if between else 0.5 / np.pi * radiance * under_a_polygon(lamp, at, np.array(normal))
        assert (seen - without_it).mean((0, 1)) == pytest.approx(expected, rel=0.02, abs=1e-4)
    ahead = camera(small(40, 30), T @ orbit_pose(np.array([2.0, 0.1, 1.0]), 0.0, np.pi, 1.5))
    seen = tracer.radiance(panes[1:], look, ahead, *paths(4), 0)
    assert seen[10:20, 15:25] == pytest.approx(np.broadcast_to(radiance, (10, 10, 3)), rel=1e-4)
    assert seen[0] == pytest.approx(np.broadcast_to(look.background, (40, 3)), abs=1e-6)


BOX = ((1.98, -0.6, 0.5), (2.0, 0.8, 1.5))
UPRIGHT = np.array([[0.0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]])
LEVEL = UPRIGHT[:, [1, 2, 0]]


def cast(tracer, things, view):
    """(region [H, W], z along the optical axis [H, W]) of Mitsuba's own hits at pixel centres; 0 where nothing is hit."""
    mi, k = tracer._mi, view.intrinsics
    scene, sensor = tracer.build(things, APPEARANCE, paths(1)[1]).scene, tracer.sensor(view)
    T_cam_world = invert(view.T_world_cam)
    region, z = np.zeros((k.height, k.width), int), np.zeros((k.height, k.width))
    for v, u in np.ndindex(k.height, k.width):
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
        rolled = orbit_and_mirror(rng, height)[seed % 2].T_world_cam @ pose(rotation_about(UP, 0.7), np.zeros(3))
        view = camera(small(120, 90, fx=131.0, fy=131.0, cx=52.3 + seed, cy=49.7), rolled)
        labels = renderer.draw(things, APPEARANCE, view)
        region, z = cast(tracer, things, view)
        inside, same = away_from_edges(labels.region), region == labels.region
        agree.append(same[inside])
        off_mm.append(1e3 * np.abs(z - labels.depth_m)[inside & same & (region > 0)])
        objects += int((labels.region[inside] >= REGION_FIRST_OBJECT).sum())
    share, median = float(np.concatenate(agree).mean()), float(np.median(np.concatenate(off_mm)))
    record_figure("traced silhouettes: share of pixels off an edge with the label's region", "ok", share, 0.999)
    record_figure("traced depth against the label pass, median mm", "ok", median, 0.05)
    assert objects > 200 and share > 0.999 and median < 0.05


@traced
def test_colour_covers_the_pixels_that_the_mask_covers(renderer, tracer):
    """Also where pixels are not square: a white sphere off the axis before a black background."""
    ball = Placed(3, shape_of(trimesh.creation.icosphere(3, 0.5)), translation(0.3, -0.2, 2.0))
    around = Appearance((1.0, 1.0, 1.0), (), BLACK, below=(1.0, 1.0, 1.0))
    for focal in ({}, {"fx": 30.0, "fy": 41.0}):
        view = camera(small(60, 44, cx=22.0, cy=27.0, **focal))
        mask = renderer.draw([ball], WHITE, view).region > 0
        light, inside = tracer.radiance([ball], around, view, *paths(4), 0)[..., 1], away_from_edges(mask)
        assert mask[inside].any() and ((light > 0.1) == mask)[inside].all()
        assert (light[inside & ~mask] == 0.0).all()


RUN = """
import hashlib
from tests.workers.render.test_pathtraced import scene_and_view, APPEARANCE, encode_light, paths
from workers.render.pathtraced import Tracer
things, view = scene_and_view(5, 96, 72)
print(hashlib.sha256(encode_light(Tracer().radiance(things, APPEARANCE, view, *paths(4), 77)).tobytes()).hexdigest())
"""


def scene_and_view(seed: int, width: int, height: int):
    rng = np.random.default_rng(seed)
    things, level = random_things(rng)
    return things, camera(small(width, height), orbit_and_mirror(rng, level)[1].T_world_cam)


@traced
@pytest.mark.minute
def test_the_same_seed_gives_the_same_bytes_here_and_in_another_process(tracer):
    things, view = scene_and_view(5, 96, 72)

    def digest(seed):
        light = tracer.radiance(things, APPEARANCE, view, *paths(4), seed)
        return hashlib.sha256(encode_light(light).tobytes()).hexdigest()

    first = digest(77)
    tracer._built = None
    assert digest(77) == first != digest(78)
    other = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True)
    assert other.stdout.split()[-1] == first


@traced
def test_sixteen_samples_leave_at_most_half_the_noise_of_four(tracer):
    """Four times the samples halve the noise of independent ones; spread evenly they do better."""
    things, view = scene_and_view(5, 48, 36)

    def noise(samples):
        many = [tracer.radiance(things, APPEARANCE, view, *paths(samples), seed) for seed in range(6)]
        return float(np.std(many, axis=0).mean())

    assert noise(16) < 0.55 * noise(4)


@traced
def test_without_global_illumination_light_reaches_only_what_sees_a_lamp(tracer):
    """A ceiling over a lit floor, seen from below: all of its light comes by way of the floor, which has Lambert's brightness."""
    ceiling = Placed(3, with_material(facing(1.0, 0.5), matte(0.8)), EYE)
    things = [Placed(1, with_material(floor().shape, matte(0.8)), EYE), ceiling]
    look, k = Appearance(BLACK, (Light(frozen_array(UP), (0.7, 0.7, 0.7)),), BLACK), small(9, 9, fx=40.0, fy=40.0)
    tiers = (paths(64), without(paths(64), "global_illumination"))
    for T, shines in ((translation(0.0, 0.0, 0.2), 0.0), (orbit_pose(np.array([3.0, 0.0, 0.0]), 0.9, 0.0, 2.0), 0.56)):
        full, direct = (tracer.radiance(things, look, camera(k, T), *one, 0).mean() for one in tiers)
        assert direct == pytest.approx(shines, rel=0.02, abs=1e-12)
        assert full == pytest.approx(direct, rel=0.05) if shines else full > 0.05


# ---------------------------------------------------------------------------------------------- the tier


def test_without_mitsuba_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"\./verso extra pathtraced.*render\.tier") as caught:
        require_mitsuba()
    assert caught.value.exit_code == 2


@traced
def test_labels_are_the_same_to_the_byte_in_all_tiers_and_without_rgb_nothing_is_traced(renderer, monkeypatch):
    things, view = scene_and_view(900, 64, 48)

    def drawn(look):
        seen = draw_view(renderer, things, APPEARANCE, view, look[0], lambda: np.random.default_rng(0), look[1])
        return seen.rgb, (seen.depth_m.tobytes(), seen.region.tobytes())

    looks = (FLAT, RASTER, FOUR, paths(1))
    coloured = [drawn(look) for look in looks]
    monkeypatch.setattr(workers.render.pathtraced, "shared_tracer", lambda: pytest.fail("a path was traced"))
    plain = [drawn(without(look, "rgb")) for look in looks]
    assert len({labels for _, labels in (*coloured, *plain)}) == 1
    assert len({rgb.tobytes() for rgb, _ in coloured}) == 4 and {rgb for rgb, _ in plain} == {None}

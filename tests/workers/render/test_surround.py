"""Light from all around: a white sphere in every built-in map and under a strong sun, in both tiers, against the map itself."""

import cv2
import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.job.look import BUILT_IN
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_TABLE, Appearance, Light, MapSource, Part, Shape
from tests.kit.tiers import first_of
from tests.workers.render.random_scenes import BLACK, EYE, FLAT, RASTER, camera, matte, paths, small, traced, without
from workers.assets.look import environment
from workers.assets.look.environment import expose_map, load_map, relight
from workers.assets.look.lights import DrawnEnvironment
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import decode_codes
from workers.geometry.frames import UP, rotation_about
from workers.geometry.irradiance import LUMINANCE

ALBEDO, TURN_RAD = 0.3, 0.7
BARE = Appearance((0.3, 0.3, 0.3), (Light(frozen_array(UP), (0.5, 0.5, 0.5)),), BLACK)
ALONE = without(RASTER, "shadows", "ambient_occlusion")
"""As a studio scene has it: nothing stands around."""
VIEWS = [orbit_pose(np.zeros(3), inclination, yaw, 1.6) for yaw, inclination in ((0.3, 0.6), (2.4, -0.7), (4.5, 0.2))]


def directions(height):
    """(unit vectors [H, 2 H, 3], solid angles [H, 1]) of a map's pixels: +x in the middle, clockwise to the right."""
    fall, turn = np.meshgrid((np.arange(height) + 0.5) * np.pi / height, (np.arange(2 * height) + 0.5) * np.pi / height)
    fall, azimuth = fall.T, np.pi - turn.T
    vectors = np.stack([np.sin(fall) * np.cos(azimuth), np.sin(fall) * np.sin(azimuth), np.cos(fall)], axis=2)
    return vectors, np.sin(fall[:, :1]) * 2.0 * (np.pi / height) * np.sin(0.5 * np.pi / height)


def sunny():
    """A grey sky, a blue ground and a sun of 10^6: three quarters of the light."""
    at, sun = directions(512)[0], np.array([0.5, 0.6, 0.62]) / np.linalg.norm([0.5, 0.6, 0.62])
    radiance = np.where(at[..., 2:] > 0.0, [0.5, 0.6, 0.7], [0.1, 0.12, 0.2])
    radiance[at @ sun > np.cos(0.002)] = 1e6
    return radiance.astype(np.float32)


def light_of(name):
    return expose_map(sunny()) if name == "sun" else load_map(MapSource(name))


@pytest.fixture
def lit(monkeypatch):
    """What a map makes of an appearance, turned by `TURN_RAD`."""

    def relit(name):
        monkeypatch.setattr(environment, "load_map", lambda source: light_of(source.name))
        return relight(BARE, None, DrawnEnvironment(MapSource(name), TURN_RAD), True)

    return relit


def sphere():
    mesh = trimesh.creation.icosphere(5, 0.5)
    vertices, faces = frozen_array(mesh.vertices), frozen_array(mesh.faces, np.int32)
    part = Part("ball", vertices, faces, matte(ALBEDO), frozen_array(mesh.vertices / 0.5))
    return Placed(REGION_FIRST_OBJECT, Shape((part,), True), EYE)


def integrated(radiance, normals):
    """[N, 3]: the light that a white surface of each normal sends out, summed over every pixel of the map."""
    at, angle = directions(len(radiance))
    pixels = (radiance * angle[..., None] / np.pi).reshape(-1, 3)
    return np.stack([np.maximum(at.reshape(-1, 3) @ n, 0.0) @ pixels for n in normals])


def normals_of(drawn, view):
    """(pixels [N, 2] of the sphere off its outline, their normals [N, 3] in the world)."""
    k, inside = view.intrinsics, cv2.erode((drawn.region > 0).view(np.uint8), np.ones((5, 5), np.uint8))
    v, u = np.nonzero(inside)
    z = drawn.depth_m[v, u].astype(float)
    points = np.stack([(u + 0.5 - k.cx) / k.fx * z, (v + 0.5 - k.cy) / k.fy * z, z], axis=1)
    world = points @ view.T_world_cam[:3, :3].T + view.T_world_cam[:3, 3]
    return np.stack([v, u], axis=1), world / np.linalg.norm(world, axis=1)[:, None]


@pytest.mark.parametrize("name", first_of(["sun", *BUILT_IN], 0, 4))
def test_a_sphere_in_tier_raster_has_the_irradiance_of_the_map(renderer, lit, name, record_figure):
    """Within 5 % everywhere but for 8 bits: its harmonics and lights against the sum over the pixels of the map."""
    look, worst = lit(name), 0.0
    for T in VIEWS:
        view = camera(small(40, 40, fx=50.0, fy=50.0), T)
        drawn = renderer.draw([sphere()], look, view, *ALONE)
        pixels, normals = normals_of(drawn, view)
        chosen = slice(None, None, 7)
        expected = integrated(look.surround.radiance, normals[chosen] @ rotation_about(UP, TURN_RAD))
        codes = drawn.rgb[tuple(pixels[chosen].T)]
        assert (codes < 230).all(), "above the knee of the tone curve"
        half = decode_codes(np.minimum(codes + 1, 255)) - decode_codes(codes)
        off = np.maximum(np.abs(decode_codes(codes) - ALBEDO * expected) - 0.6 * half, 0.0)
        worst = max(worst, float((off / (ALBEDO * expected)).max()))
    record_figure(f"irradiance of tier raster in {name}", "ok", worst, 0.05)
    assert worst < 0.05


@traced
@pytest.mark.parametrize("name", first_of(["sun", *BUILT_IN], 1))
def test_both_tiers_agree_on_the_sphere_and_show_the_same_picture_behind_it(renderer, tracer, lit, name):
    look, view = lit(name), camera(small(40, 40, fx=50.0, fy=50.0), VIEWS[2])
    drawn = renderer.draw([sphere()], look, view, *ALONE)
    light = tracer.radiance([sphere()], look, view, *paths(256), 1)
    inside = cv2.erode((drawn.region > 0).view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    blocks = [(inside & (np.add.outer(np.arange(40) // 8 * 5, np.arange(40) // 8) == n)) for n in range(25)]
    both = [(decode_codes(drawn.rgb[b]).mean(0), light[b].mean(0)) for b in blocks if b.sum() > 20]
    assert len(both) > 8 and max(float((np.abs(a - b) / b).max()) for a, b in both) < 0.05
    behind = drawn.region == 0
    behind &= cv2.erode(behind.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    seen = np.abs(environment_codes(light)[behind] - drawn.rgb[behind].astype(int))
    assert np.median(seen) <= 1 and np.quantile(seen, 0.9) <= 8


def environment_codes(light):
    from workers.render.pathtraced import encode_light

    return encode_light(light).astype(int)


def test_labels_do_not_depend_on_the_look_and_tier_flat_leaves_it_out(renderer, lit):
    view = camera(small(64, 48), VIEWS[0])
    plain = renderer.draw([sphere()], BARE, view, *RASTER)
    look = renderer.draw([sphere()], lit("softboxes"), view, *RASTER)
    assert (plain.region == look.region).all() and (plain.depth_m == look.depth_m).all()
    assert (plain.rgb != look.rgb).any(axis=2).mean() > 0.9
    flat = renderer.draw([sphere()], relight(BARE, None, None, True), view, *FLAT)
    assert (flat.rgb == renderer.draw([sphere()], BARE, view, *FLAT).rgb).all()


@pytest.mark.parametrize("name", first_of(["sun", *BUILT_IN], 1))
def test_a_level_white_surface_is_just_below_what_clips_and_none_is_burnt_out(name):
    radiance = light_of(name).radiance
    normals = np.concatenate([[UP], np.random.default_rng(0).normal(size=(200, 3))])
    received = integrated(radiance, normals / np.linalg.norm(normals, axis=1)[:, None]) @ LUMINANCE
    assert 0.3 < received[0] < 0.97 and received.max() < 2.05
    assert received[0] > 0.93 or received.max() > 1.95


def on_a_table(renderer, elevation_deg, size_deg):
    """(linear light, x) of the pixels [H, W] of a table top with a box on it, seen from above; the light comes from +x."""
    slab, box = trimesh.creation.box((1.6, 1.6, 0.1)), trimesh.creation.box((0.1, 0.1, 0.1))
    slab.apply_translation((0.0, 0.0, 0.55))
    box.apply_translation((0.4, 0.0, 0.65))
    things = tuple(
        Placed(
            region,
            Shape((Part("x", frozen_array(m.vertices), frozen_array(m.faces, np.int32), matte(0.5)),), True),
            EYE,
        )
        for region, m in ((REGION_TABLE, slab), (REGION_FIRST_OBJECT, box))
    )
    e = np.radians(elevation_deg)
    color = (0.6 / np.sin(e),) * 3
    light = Light(frozen_array([np.cos(e), 0.0, np.sin(e)]), color, float(np.radians(size_deg)))
    look = Appearance((0.3,) * 3, (light,), BLACK, (0.2,) * 3)
    view = camera(small(160, 160), orbit_pose(np.zeros(3), np.pi / 2 - 1e-3, np.pi, 1.3))
    drawn = renderer.draw(things, look, view, *RASTER)
    v, u = np.indices(drawn.region.shape) + 0.5
    points = np.stack([(u - 80.0) / 80.0, (v - 80.0) / 80.0, np.ones(u.shape)], axis=2) * drawn.depth_m[..., None]
    x = (points @ view.T_world_cam[:3, :3].T + view.T_world_cam[:3, 3])[..., 0]
    return np.where(drawn.region == REGION_TABLE, decode_codes(drawn.rgb).mean(axis=2), np.nan), x


def test_a_low_light_leaves_an_open_table_lit_and_a_wide_lamp_blurs_its_shadows(renderer):
    """Lambert, and a little that is mirrored, on the side of the light, without stripes; and a shadow's steepest step."""
    for elevation in (6.0, 12.0, 25.0, 60.0):
        top, x = on_a_table(renderer, elevation, 1.0)
        open_side = top[(x > 0.56) & np.isfinite(top)]
        assert len(open_side) > 500
        assert open_side == pytest.approx(0.5 * (0.3 + 0.6) + 0.04 * 0.4, rel=0.03)
    steps = [np.nanmax(np.abs(np.diff(on_a_table(renderer, 35.0, size)[0], axis=0))) for size in (1.0, 8.0, 20.0)]
    assert steps[0] > 1.25 * steps[1] and steps[1] > 1.1 * steps[2]

"""The path-traced tier: the same camera, labels and lights as the others, and what light does, against formulas."""

import hashlib
import importlib.util
import subprocess
import sys

import cv2
import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.errors import InputError
from schemas.job.render import Render
from schemas.scene.appearance import Appearance, Light
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import Placed
from schemas.scene.shape import Material, Part, Shape
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
from workers.render.pathtraced.lights import lamp_directions, sky_directions, sky_picture
from workers.render.pathtraced.materials import tint_of
from workers.render.pathtraced.tracer import Tracer, require_mitsuba, square_pixels, whole_grid, without_specks
from workers.render.step import draw_view

HERE = importlib.util.find_spec("mitsuba") is not None
traced = pytest.mark.skipif(not HERE, reason="Mitsuba is not installed: the path-traced tier goes untested")

FLAT, RASTER = Render(tier="flat"), Render(tier="raster")
BLACK = (0.0, 0.0, 0.0)
DOWN = Light(frozen_array([0.0, 0.0, 1.0]), (0.7, 0.7, 0.7))


def paths(samples: int, bounces: int = 8) -> Render:
    return Render(tier="pathtraced", path_samples=samples, path_bounces=bounces)


@pytest.fixture(scope="module")
def tracer() -> Tracer:
    return Tracer()


def with_material(shape: Shape, material: Material) -> Shape:
    return Shape(tuple(Part(p.name, p.vertices, p.faces, material, p.normals, p.uv, p.colors) for p in shape.parts))


def matte(albedo: float) -> Material:
    """The sRGB value whose linear light is `albedo`."""
    s = 12.92 * albedo if albedo <= 0.0031308 else 1.055 * albedo ** (1 / 2.4) - 0.055
    return Material((s, s, s, 1.0), roughness=1.0)


def cast(tracer, things, appearance, view):
    """(region [H, W], z along the optical axis [H, W]) of Mitsuba's own hits at pixel centres; 0 where nothing is hit."""
    mi, k = tracer._mi, view.intrinsics
    scene, sensor = tracer.build(things, appearance).scene, tracer.sensor(view)
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
def test_labels_are_the_same_to_the_byte_in_all_tiers(renderer):
    rng = np.random.default_rng(900)
    things, height = random_things(rng)
    view = camera(small(64, 48), orbit_and_mirror(rng, height)[0].T_world_cam)
    drawn = [draw_view(renderer, things, APPEARANCE, view, tier, rng) for tier in (FLAT, RASTER, paths(1))]
    assert len({one.depth_m.tobytes() for one in drawn}) == 1
    assert len({one.region.tobytes() for one in drawn}) == 1
    assert len({one.rgb.tobytes() for one in drawn}) == 3


@traced
@pytest.mark.parametrize("k", [small(60, 44, cx=22.0, cy=27.0), small(60, 44, fx=30.0, fy=41.0, cx=22.0, cy=27.0)])
def test_colour_covers_the_pixels_that_the_mask_covers(renderer, tracer, k):
    """Also where pixels are not square: a white sphere off the axis before a black background."""
    ball = Placed(3, shape_of(trimesh.creation.icosphere(3, 0.5)), translation(0.3, -0.2, 2.0))
    mask = renderer.draw([ball], WHITE, camera(k)).region > 0
    around = Appearance((1.0, 1.0, 1.0), (), BLACK, below=(1.0, 1.0, 1.0))
    light = tracer.radiance([ball], around, camera(k), paths(4), 0)[..., 1]
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
from schemas.job.render import Render
from workers.render.pathtraced.materials import tint_of
from workers.render.pathtraced.tracer import Tracer
rng = np.random.default_rng(5)
things, height = random_things(rng)
view = camera(small(96, 72), orbit_and_mirror(rng, height)[1].T_world_cam)
print(hashlib.sha256(Tracer().trace(things, APPEARANCE, view, Render(path_samples=4), 77).tobytes()).hexdigest())
"""


@traced
def test_the_same_seed_gives_the_same_bytes_here_and_in_another_process(tracer):
    rng = np.random.default_rng(5)
    things, height = random_things(rng)
    view = camera(small(96, 72), orbit_and_mirror(rng, height)[1].T_world_cam)

    def digest(seed):
        return hashlib.sha256(tracer.trace(things, APPEARANCE, view, paths(4), seed).tobytes()).hexdigest()

    first = digest(77)
    tracer.forget()
    assert digest(77) == first != digest(78)
    other = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True)
    assert other.stdout.split()[-1] == first


# ------------------------------------------------------------------------------------------------ light


@traced
@pytest.mark.parametrize("angle", [0.0, 0.5, 1.0])
def test_a_lit_plane_is_as_bright_as_lambert_says(tracer, angle):
    """albedo x irradiance / pi, that is albedo x color x cosine, to 2 %: lamps and glow together."""
    light = Light(frozen_array([np.sin(angle), 0.0, np.cos(angle)]), (0.9, 0.8, 0.7))
    ground = Placed(1, with_material(floor().shape, matte(0.5)), EYE)
    view = camera(small(24, 24), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    seen = tracer.radiance([ground], Appearance(BLACK, (light,), BLACK), view, paths(16), 0)[8:16, 8:16].mean((0, 1))
    assert seen == pytest.approx(0.5 * np.cos(angle) * np.array(light.color), rel=0.02)


@traced
def test_a_plane_under_an_open_sky_sees_the_ambient_light_whatever_the_skys_gradient(tracer):
    ambient = (0.4, 0.5, 0.6)
    ground = Placed(1, with_material(floor().shape, matte(0.5)), EYE)
    view = camera(small(24, 24), orbit_pose(np.zeros(3), 0.8, 0.3, 2.0))
    seen = tracer.radiance([ground], Appearance(ambient, (), BLACK), view, paths(16), 0)[8:16, 8:16].mean((0, 1))
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
        seen = tracer.radiance([wall], look, camera(small(9, 9, fx=60.0, fy=60.0), eye), paths(64), 0)[3:6, 3:6].mean()
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
    drawn = renderer.draw([Placed(3, card, EYE)], look, view, FLAT).rgb
    seen = tracer.trace([Placed(3, card, EYE)], look, view, paths(16), 0)
    for v, u in ((8, 8), (8, 24), (24, 8), (24, 24)):
        assert (drawn[v, u] > 120).tolist() == (seen[v, u] > 120).tolist(), f"at {u}, {v}"


# ------------------------------------------------------------------------------------------------ glass, holes, noise

GLASS = Material((0.7, 0.8, 0.8, 1.0), roughness=0.1, transmission=1.0)
RED = Material((0.9, 0.05, 0.05, 1.0), roughness=1.0)


def through(tracer, material, samples=64):
    """Mean linear colour of a red wall with a pane of this material in front of it."""
    wall = Placed(3, with_material(facing(3.0, 9.0), RED), EYE)
    pane = Placed(4, with_material(facing(2.0, 4.0), material), EYE)
    look = Appearance((0.8, 0.8, 0.8), (), BLACK, (0.8, 0.8, 0.8))
    return tracer.radiance([wall, pane], look, camera(small(9, 9)), paths(samples), 0).mean((0, 1))


@traced
def test_a_thing_behind_glass_is_seen_and_behind_anything_else_is_not(tracer):
    red, green = through(tracer, GLASS)[:2]
    assert red > 3.0 * green
    red, green = through(tracer, matte(0.5))[:2]
    assert red == pytest.approx(green, rel=0.05)


@traced
def test_the_second_side_of_a_wall_changes_nothing(tracer):
    behind = Material((0.7, 0.8, 0.8, 1.0), transmission=1.0, ior=1.0)
    (part,) = facing(3.0, 9.0).parts
    wall = Placed(3, with_material(facing(3.0, 9.0), RED), EYE)
    look = Appearance((0.8, 0.8, 0.8), (), BLACK, (0.8, 0.8, 0.8))
    alone = tracer.radiance([wall], look, camera(small(9, 9)), paths(64), 0).mean((0, 1))
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
    seen = tracer.radiance([wall, pane], look, camera(small(16, 16)), paths(16), 0)
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
        return tracer.radiance([ground, roof], look, view, paths(64), 0)[3:6, 3:6].mean()

    lit = tracer.radiance([ground], look, view, paths(64), 0)[3:6, 3:6].mean()
    assert shadow(matte(0.5)) < 0.3 * lit
    assert 0.6 * lit < shadow(GLASS) < 0.98 * lit


@traced
def test_sixteen_samples_leave_at_most_half_the_noise_of_four(tracer):
    """Four times the samples halve the noise of independent ones; spread evenly they do better."""
    rng = np.random.default_rng(5)
    things, height = random_things(rng)
    view = camera(small(48, 36), orbit_and_mirror(rng, height)[1].T_world_cam)

    def noise(samples):
        many = [tracer.radiance(things, APPEARANCE, view, paths(samples), seed) for seed in range(6)]
        return float(np.std(many, axis=0).mean())

    assert noise(16) < 0.55 * noise(4)


def test_specks_are_taken_away_and_lines_and_spots_of_three_pixels_stay():
    light = np.full((9, 9, 3), 0.2)
    light[4, 4] = light[0, 8] = 5.0
    light[1, 1] = light[2, 1] = light[2, 2] = 3.0
    light[7, :] = 0.5
    seen = without_specks(light)
    specks = np.zeros((9, 9), bool)
    specks[4, 4] = specks[0, 8] = True
    assert seen[specks] == pytest.approx(0.2)
    assert (seen[~specks] == light[~specks]).all()
    assert (without_specks(np.ones((1, 1, 3))) == 1.0).all()


def test_samples_fill_a_grid_and_are_never_fewer_than_asked():
    for asked in range(1, 300):
        taken = whole_grid(asked)
        assert asked <= taken < asked + np.sqrt(asked)
        assert any(taken % side == 0 for side in range(int(np.sqrt(asked)), int(np.sqrt(asked)) + 1))
    assert [whole_grid(n) for n in (1, 2, 4, 13, 16, 64)] == [1, 2, 4, 15, 16, 64]


def test_without_mitsuba_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"\./verso extra pathtraced.*render\.tier") as caught:
        require_mitsuba()
    assert caught.value.exit_code == 2

"""Labels: depth and regions against the ray caster, region by region, and against arithmetic; the floor that is known."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import trimesh

import workers.render.raster.gbuffer
from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Camera, Intrinsics
from tests.workers.render.looks import FLAT, without
from tests.workers.render.random_scenes import (
    APPEARANCE,
    EYE,
    FLOOR_HALF_M,
    VGA,
    WHITE,
    camera,
    facing,
    five_procedural_things,
    floor,
    object_shape,
    orbit_and_mirror,
    procedural_things,
    quad,
    random_things,
    shape_of,
    small,
    stand,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import invert, pose, translation, uniform_rotation
from workers.geometry.raycast import cast_view, edge_distance_px
from workers.geometry.zbuffer import count_covered
from workers.render.raster.context import is_software
from workers.render.raster.gbuffer import Renderer
from workers.render.raster.ground import fills_image, find_ground
from workers.render.raster.shaders import GRAZING

FARTHEST_M = 10.0
"""The floor of the dataset's cameras reaches to 9 m; what lies beyond 8 m is not stored. float32 itself has steps of
0.004 mm beyond 32 m."""

EDGE_PX = 1 / 64
"""A pixel centre nearer than this to a projected edge may fall to either side."""

BOUNDS = {
    "mask: farthest disagreement from an edge, px": EDGE_PX,
    "mask: share of pixels that disagree at an edge": 2e-5,
    "floor: depth p99.9, mm": 0.01,
    "table: depth p99.9, mm": 0.01,
    "object: depth median, mm": 0.01,
    "object: depth p99 below 80 degrees, mm": 0.05,
}

Scenes = Callable[[np.random.Generator], tuple[list[Placed], float]]


def views(make: Scenes, seeds: Iterable[int]) -> Iterable[tuple[list[Placed], Camera]]:
    """Two views a scene; in every other scene by a camera with uneven intrinsics."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        things, height = make(rng)
        (fx, fy), cx, cy = rng.uniform(400, 700, 2), rng.uniform(250, 390), rng.uniform(180, 300)
        k = VGA.model_copy(update={"fx": fx, "fy": fy, "cx": cx, "cy": cy} if seed % 2 else {})
        for view in orbit_and_mirror(rng, height, k):
            yield things, view


def score(renderer: Renderer, make: Scenes, seeds: Iterable[int]) -> dict[str, float]:
    """The worst figure of any view and region, under the names of `BOUNDS`."""
    worst: dict[str, float] = defaultdict(float)
    at_edges = pixels = 0
    for things, view in views(make, seeds):
        seen = renderer.draw(things, APPEARANCE, view)
        depth, region, cosine = cast_view(things, view)
        differ = np.argwhere(seen.region != region)
        away = edge_distance_px(things, view, differ, outline_only=True)
        at_edges, pixels = at_edges + len(differ), pixels + region.size
        figures = {"mask: farthest disagreement from an edge, px": float(away.max(initial=0.0))}
        error_mm = np.abs(seen.depth_m.astype(np.float64) - depth) * 1e3
        for region_id in np.unique(region[region > 0]):
            same = (region == region_id) & (seen.region == region_id) & (depth < FARTHEST_M)
            figures |= depth_figures(int(region_id), error_mm[same], cosine[same])
            for name, figure in figures.items():
                worst[name] = max(worst[name], figure)
    worst["mask: share of pixels that disagree at an edge"] = at_edges / pixels
    return worst


def depth_figures(region_id: int, error_mm: np.ndarray, cosine: np.ndarray) -> dict[str, float]:
    steep = error_mm if region_id <= 2 else error_mm[cosine > math.cos(math.radians(80.0))]
    if not len(steep):
        return {}
    if region_id <= 2:
        return {f"{('floor', 'table')[region_id - 1]}: depth p99.9, mm": float(np.percentile(steep, 99.9))}
    median, p99 = np.percentile(steep, [50.0, 99.0]).tolist()
    return {"object: depth median, mm": median, "object: depth p99 below 80 degrees, mm": p99}


KINDS = {
    "rods, bowls and boxes": random_things,
    "built-in shapes": procedural_things,
    "five built-in shapes": five_procedural_things,
}


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        *((kind, 2) for kind in KINDS),
        *(pytest.param(kind, 12, marks=pytest.mark.minute) for kind in KINDS),
        *(pytest.param(kind, 200, marks=pytest.mark.slow) for kind in KINDS),
    ],
)
def test_labels_agree_with_rays_in_every_region(renderer, record_figure, kind, count):
    worst = score(renderer, KINDS[kind], range(count))
    assert set(worst) == set(BOUNDS), "some region was never seen"
    missed = {name: worst[name] for name, bound in BOUNDS.items() if not worst[name] <= bound}
    for name, bound in BOUNDS.items():
        record_figure(f"{kind}, {count} scenes: {name}", "failed" if name in missed else "passed", worst[name], bound)
    assert not missed


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4096, 2), (3, 4096), (641, 479)])
def test_any_image_size_agrees_with_rays(renderer, width, height):
    rng, f = np.random.default_rng(1), max(width, height)
    k = Intrinsics(width=width, height=height, fx=0.8 * f, fy=0.9 * f, cx=0.47 * width, cy=0.55 * height)
    things, table = random_things(rng)
    view = Camera(k, orbit_and_mirror(rng, table)[0].T_world_cam)
    seen, (depth, region, _) = renderer.draw(things, APPEARANCE, view), cast_view(things, view)
    assert seen.rgb.shape == (height, width, 3) and seen.depth_m.shape == seen.region.shape == (height, width)
    assert (edge_distance_px(things, view, np.argwhere(seen.region != region)) < EDGE_PX).all()
    floor_seen = (region == 1) & (seen.region == 1)
    assert np.abs(seen.depth_m - depth)[floor_seen].max(initial=0.0) < 2e-6 * max(1.0, depth.max())


def test_depth_is_taken_at_pixel_centres(renderer):
    """On a plane this steep half a pixel is 5 mm of depth; float32 has a few units in the last place."""
    normal, h = np.array([0.0, 1.0, 0.4]), 3.0
    corners = [[x, y, (1.0 - normal[1] * y) / normal[2]] for x, y in ((-h, -0.2), (h, -0.2), (h, 0.9), (-h, 0.9))]
    k = VGA.model_copy(update={"cx": 317.2, "cy": 251.9})
    seen = renderer.draw([Placed(7, quad(corners), EYE)], APPEARANCE, camera(k))
    hit = seen.region == 7
    expected = np.broadcast_to(1.0 / ((np.arange(k.height)[:, None] + 0.5 - k.cy) / k.fy + 0.4), hit.shape)
    assert hit.mean() > 0.5
    assert np.abs(seen.depth_m - expected)[hit].max() < 1e-6
    assert np.abs(expected[1:] - expected[:-1])[hit[1:]].min() > 1e-3, "the plane is too flat to tell half pixels"


def test_a_mask_ends_between_the_pixel_centres_on_both_sides_of_an_edge(renderer):
    k = small(20, 10, fx=10.0, fy=10.0, cx=0.0, cy=0.0)  # at z = 10 a metre is a pixel
    for right, columns in {7.49: 7, 7.51: 8, 7.98: 8, 8.49: 8, 8.51: 9}.items():
        tile = quad([[2, 3, 10], [right, 3, 10], [right, 6, 10], [2, 6, 10]])
        region = renderer.draw([Placed(3, tile, EYE)], APPEARANCE, camera(k)).region
        expected = np.zeros((10, 20), bool)
        expected[3:6, 2:columns] = True
        np.testing.assert_array_equal(region == 3, expected, err_msg=f"right edge at {right}")


@pytest.mark.parametrize("turned", [False, True], ids=["same-triangles", "other-triangles"])
def test_of_coplanar_faces_the_lowest_region_id_wins(renderer, turned):
    """Two overlapping squares in one plane, in 30 random poses and seen at up to 80 degrees; the order given is no help."""
    corners = np.array([[-0.4, -0.3, 0.0], [0.4, -0.3, 0.0], [0.4, 0.3, 0.0], [-0.4, 0.3, 0.0]])
    low, high = quad(corners), quad(corners * 0.8 + [0.05, 0.02, 0.0], turned)
    wrong = pixels = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.5, 4.0)]))
        # The second shape stands elsewhere in its own frame, so that its plane is rounded in another way.
        shift = translation(*rng.uniform(-1.0, 1.0, 2), 0.0)
        moved = Shape(tuple(Part("p", frozen_array(p.vertices - shift[:3, 3]), p.faces) for p in high.parts))
        things = [Placed(9, moved, T @ shift), Placed(4, low, T)]
        seen = renderer.draw(things, APPEARANCE, camera())
        inside = renderer.draw(things[1:], APPEARANCE, camera()).region == 4
        wrong, pixels = wrong + int((inside & (seen.region != 4)).sum()), pixels + int(inside.sum())
    assert pixels > 250_000
    assert wrong == 0


def test_the_twentieth_of_many_is_not_lost_behind_what_it_lies_closely_over(renderer):
    """A plate 0.05 mm above another and seen from 2.5 m hides it, however many others there are."""
    flat, cube = (shape_of(trimesh.creation.box(sides)) for sides in ((0.3, 0.3, 0.001), (0.1, 0.1, 0.1)))
    far = [Placed(3 + k, cube, translation(0.2 * k - 1.0, 1.0, 0.0)) for k in range(19)]
    things = [Placed(2, flat, EYE), *far, Placed(22, flat, translation(0.0, 0.0, 0.00005))]
    view = camera(T=orbit_pose(np.zeros(3), 0.8, 0.3, 2.5))
    region = renderer.draw(things, APPEARANCE, view).region
    seen = region[renderer.draw(things[-1:], APPEARANCE, view).region == 22]
    assert len(seen) > 2000
    assert (seen == 22).mean() > 0.98  # all but the plate's lower edge


# ---------------------------------------------------------------------------------------------- counts


def test_pixels_outside_the_frame_and_behind_others_are_counted(renderer):
    """A disc pushed over the edges of the image keeps its count, whole pixel by whole pixel."""
    disc = Placed(3, shape_of(trimesh.creation.cylinder(0.2, 0.01, sections=200)), translation(0.0, 0.0, 1.0))
    whole = renderer.count_pixels([disc], camera())[0]
    assert whole == pytest.approx(np.pi * (0.2 * 525 / 0.995) ** 2, rel=2e-3)
    for moved in ({"cx": -50.0}, {"cx": 640.0}, {"cy": 480.0}, {"cx": -100.0, "cy": 570.0}):
        view = camera(VGA.model_copy(update=moved))
        assert renderer.count_pixels([disc], view)[0] == pytest.approx(whole, abs=3)
    assert (renderer.draw([disc], APPEARANCE, view).region == 3).sum() < whole / 100


def test_the_processor_counts_the_same_pixels(renderer):
    """To the pixel where the driver is llvmpipe on a processor with FMA; other drivers may move a corner by 1/256 pixel."""
    rng, off = np.random.default_rng(5), []
    for _ in range(24):
        shape = object_shape(rng)
        for one in (shape, replace(shape, closed=not shape.closed)) if shape.closed else (shape,):
            T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.6, 2.0)]))
            off.append(abs(count_covered(one, T, VGA) - renderer.count_pixels([Placed(3, one, T)], camera())[0]))
    assert max(off) <= 2
    assert np.mean(np.array(off) == 0) > 0.9


# ---------------------------------------------------------------------------------------------- the known floor

K = Intrinsics(width=100, height=80, fx=100.0, fy=100.0, cx=50.0, cy=40.0)


def rays_of(T_world_cam: np.ndarray) -> np.ndarray:
    """[41, 41, 3] world: of z 1, evenly over the image and its border."""
    x, y = np.meshgrid(np.linspace(0, K.width, 41), np.linspace(0, K.height, 41))
    return np.stack([(x - K.cx) / K.fx, (y - K.cy) / K.fy, np.ones_like(x)], -1) @ T_world_cam[:3, :3].T


def test_a_floor_that_fills_the_image_is_met_by_every_ray_above_the_grazing_angle():
    """True for nearly all views that meet it so, but for those at the limit; never for one that does not somewhere."""
    rng, filling = np.random.default_rng(5), []
    for turn in range(400):
        # The highest rays are level at an inclination of 0.38
        inclination = rng.uniform(-1.5, 1.5) if turn % 2 else rng.uniform(0.36, 0.42)
        eye = rng.normal(0.0, 12.0, 3) * [1, 1, 0]
        T_world_cam = orbit_pose(eye, inclination, rng.uniform(-3, 3), 3.0)
        rays = rays_of(T_world_cam)
        away = -T_world_cam[2, 3] / rays[..., 2]
        met = T_world_cam[:2, 3] + away[..., None] * rays[..., :2]
        cosine = rays[..., 2] / np.linalg.norm(rays, axis=-1)
        every = bool((away > 0.05).all() and (abs(met) < FLOOR_HALF_M).all() and (abs(cosine) > GRAZING).all())
        filling.append((every, fills_image(floor().shape, invert(T_world_cam), K)))
    every, found = np.array(filling).T
    assert not (found & ~every).any()
    assert 40 < found.sum() < 360
    assert found[1::2].sum() >= 0.9 * every[1::2].sum()


GPU_DIVISION = 2.0**-21
"""Relative error of z that a GPU draws: GLSL allows a division 2.5 units in the last place, and fused sums another one or two."""


def sunken_scene(seed: int):
    """Things and three views, one from below: a table with objects, and two objects on the floor, in it or just above it."""
    rng = np.random.default_rng(9_000 + seed)
    things, height = procedural_things(rng) if seed % 2 else random_things(rng)
    for depth_m in (rng.choice([-2e-5, -5e-6, -1e-6]), rng.choice([0.0, 1e-6, 1e-5, 1e-4, 1e-3, 0.02])):
        shape, spot = object_shape(rng), rng.uniform(-0.9, 0.9, 2)
        things.append(Placed(len(things) + 1, shape, stand(shape, uniform_rotation(rng), spot, -depth_m)))
    below = camera(T=orbit_pose(np.zeros(3), -rng.uniform(0.7, 1.5), rng.uniform(-3, 3), 2.5))
    return tuple(things), (*orbit_and_mirror(rng, height), below)


@pytest.mark.parametrize("tier", ["flat", "labels alone"])
def test_a_known_floor_is_seen_to_the_same_bytes(renderer, tier):
    look, met, found = {"flat": FLAT, "labels alone": without(FLAT, "rgb")}[tier], 0, []
    for seed in range(6):
        things, three = sunken_scene(seed)
        for view in three:
            with mock.patch.object(
                workers.render.raster.gbuffer,
                "find_ground",
                lambda *given: found.append(find_ground(*given)) or found[-1],
            ):
                seen = renderer.draw(things, APPEARANCE, view, *look)
            assert found[-1] is not None
            with mock.patch.object(workers.render.raster.gbuffer, "find_ground", return_value=None):
                drawn = renderer.draw(things, APPEARANCE, view, *look)
            assert (seen.rgb is None and drawn.rgb is None) or seen.rgb.tobytes() == drawn.rgb.tobytes()
            assert seen.region.tobytes() == drawn.region.tobytes()
            exact = is_software(renderer.name)
            np.testing.assert_allclose(seen.depth_m, drawn.depth_m, rtol=0.0 if exact else GPU_DIVISION)
            met += bool((seen.region == things[-1].region_id).any())
            assert view is not three[2] or (seen.region == 1).mean() > 0.9
    assert met >= 4, "what lies on the floor is seen in many scenes"


@pytest.mark.parametrize("inclination", [-0.9, 0.05, 0.3, 0.9])
def test_nothing_of_the_image_before_is_left_whether_or_not_the_floor_fills_the_image(renderer, inclination):
    """With a horizon in two of these views, which show the background above it; from below and from above."""
    view = camera(small(64, 48), orbit_pose(np.zeros(3), inclination, 0.3, 1.0))
    cube = Placed(3, shape_of(trimesh.creation.box((0.1, 0.1, 0.1))), translation(0.0, 0.0, 0.06))
    seen = []
    for before, distance_m in ((9, 0.5), (200, 3.0)):
        renderer.draw([Placed(before, facing(distance_m), EYE)], WHITE, camera(small(64, 48)))
        seen.append(renderer.draw([floor(), cube], WHITE, view))
    for name in ("rgb", "depth_m", "region"):
        np.testing.assert_array_equal(*(getattr(one, name) for one in seen))
    assert (seen[0].region == 0).any() == (abs(inclination) < 0.5)

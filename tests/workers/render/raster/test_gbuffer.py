"""Pixels that a thing alone would cover, also outside the image.

Depth and regions of simple scenes, against arithmetic and against the ray caster. One renderer over many scenes: the
same bytes, bounded stores, flat memory; and none where there is no OpenGL. Effects of colour: each is drawn because
the plan runs it; labels never depend on them, nor on the process.
"""

import hashlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from tests.workers.render.looks import FLAT, FOUR, RASTER, Look, without
from tests.workers.render.random_scenes import (
    APPEARANCE,
    EYE,
    VGA,
    WHITE,
    camera,
    facing,
    floor,
    object_shape,
    orbit_and_mirror,
    procedural_things,
    quad,
    random_things,
    shape_of,
    small,
)
from workers.geometry import raycast
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import pose, translation, uniform_rotation
from workers.geometry.raycast import cast_view
from workers.geometry.zbuffer import count_covered
from workers.render.raster.buffers import MAX_SHAPES


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


PLANE_MM = 0.001
"""float32 depth of a plane some metres away: a few units in the last place."""


def plane_depth(k: Intrinsics, normal, offset: float):
    """Depth of the plane normal . p = offset at every pixel's centre."""
    v, u = np.mgrid[0 : k.height, 0 : k.width] + 0.5
    return offset / (normal[0] * (u - k.cx) / k.fx + normal[1] * (v - k.cy) / k.fy + normal[2])


def test_depth_is_taken_at_pixel_centres(renderer):
    """On a plane this steep half a pixel is 5 mm of depth."""
    normal = np.array([0.0, 1.0, 0.4])
    h = 3.0
    corners = [[x, y, (1.0 - normal[1] * y) / normal[2]] for x, y in ((-h, -0.2), (h, -0.2), (h, 0.9), (-h, 0.9))]
    k = VGA.model_copy(update={"cx": 317.2, "cy": 251.9})
    seen = renderer.draw([Placed(7, quad(corners), EYE)], APPEARANCE, camera(k))
    hit = seen.region == 7
    expected = plane_depth(k, normal, 1.0)
    assert hit.mean() > 0.5
    assert np.abs(seen.depth_m - expected)[hit].max() * 1e3 < PLANE_MM
    assert np.abs(expected[1:] - expected[:-1])[hit[1:]].min() * 1e3 > 1.0, "the plane is too flat to tell half pixels"


def test_a_mask_ends_between_the_pixel_centres_on_both_sides_of_an_edge(renderer):
    k = small(20, 10, fx=10.0, fy=10.0, cx=0.0, cy=0.0)  # at z = 10 a metre is a pixel
    edges = {7.49: 7, 7.51: 8, 7.98: 8, 8.49: 8, 8.51: 9}
    for right, columns in edges.items():
        square = quad([[2, 3, 10], [right, 3, 10], [right, 6, 10], [2, 6, 10]])
        region = renderer.draw([Placed(3, square, EYE)], APPEARANCE, camera(k)).region
        expected = np.zeros((10, 20), bool)
        expected[3:6, 2:columns] = True
        np.testing.assert_array_equal(region == 3, expected, err_msg=f"right edge at {right}")


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4096, 2), (3, 4096), (641, 479)])
def test_any_image_size_agrees_with_rays(renderer, width, height):
    rng = np.random.default_rng(1)
    f = max(width, height)
    k = Intrinsics(width=width, height=height, fx=0.8 * f, fy=0.9 * f, cx=0.47 * width, cy=0.55 * height)
    things, table = random_things(rng)
    view = Camera(k, orbit_and_mirror(rng, table)[0].T_world_cam)
    seen = renderer.draw(things, APPEARANCE, view)
    depth, region, _ = cast_view(things, view)
    assert seen.rgb.shape == (height, width, 3) and seen.depth_m.shape == seen.region.shape == (height, width)
    different = np.argwhere(seen.region != region)
    assert (raycast.edge_distance_px(things, view, different) < 1 / 64).all()
    floor_seen = (region == 1) & (seen.region == 1)
    assert np.abs(seen.depth_m - depth)[floor_seen].max(initial=0.0) < 2e-6 * max(1.0, depth.max())


def test_both_sides_of_a_face_are_drawn_and_lit(renderer):
    """The same square seen from its front and from its back, lit from the camera's side, with shading normals or none."""
    key = Appearance((0.0, 0.0, 0.0), (Light(frozen_array([0.0, 0.0, -1.0]), (0.5, 0.5, 0.5)),), (0.0, 0.0, 0.0))
    for normals in (None, frozen_array([[0.0, 0.0, 1.0]] * 4)):
        (part,) = facing(2.0).parts
        front = Part("square", part.vertices, part.faces, Material(roughness=1.0), normals)
        back = Part(
            "square", part.vertices, frozen_array(part.faces[:, ::-1], np.int32), Material(roughness=1.0), normals
        )
        seen = [renderer.draw([Placed(3, Shape((p,)), EYE)], key, camera(small(8, 8))) for p in (front, back)]
        assert all((view.region == 3).all() for view in seen)
        np.testing.assert_array_equal(seen[0].rgb, seen[1].rgb)
        assert seen[0].rgb.min() > 60


@pytest.mark.parametrize("turned", [False, True], ids=["same-triangles", "other-triangles"])
def test_of_coplanar_faces_the_lowest_region_id_wins(renderer, turned):
    """Two overlapping squares in one plane, in 60 random poses and seen at up to 80 degrees; the order given is no help."""
    corners = np.array([[-0.4, -0.3, 0.0], [0.4, -0.3, 0.0], [0.4, 0.3, 0.0], [-0.4, 0.3, 0.0]])
    low, high = quad(corners), quad(corners * 0.8 + [0.05, 0.02, 0.0], turned)
    wrong = pixels = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.5, 4.0)]))
        # The second shape stands elsewhere in its own frame, so that its plane is rounded in another way.
        shift = translation(*rng.uniform(-1.0, 1.0, 2), 0.0)
        moved = Shape(tuple(Part("p", frozen_array(p.vertices - shift[:3, 3]), p.faces) for p in high.parts))
        things = [Placed(9, moved, T @ shift), Placed(4, low, T)]
        seen = renderer.draw(things, APPEARANCE, camera())
        inside = renderer.draw(things[1:], APPEARANCE, camera()).region == 4
        wrong += int((inside & (seen.region != 4)).sum())
        pixels += int(inside.sum())
    assert pixels > 500_000
    assert wrong == 0


@pytest.mark.parametrize("inclination", [-0.9, 0.05, 0.3, 0.9])
def test_nothing_of_the_image_before_is_left_whether_or_not_the_floor_fills_the_image(renderer, inclination):
    """With a horizon in two of these views, which show the background above it; from below and from above."""
    view = camera(small(64, 48), orbit_pose(np.zeros(3), inclination, 0.3, 1.0))
    body = Placed(3, shape_of(trimesh.creation.box((0.1, 0.1, 0.1))), translation(0.0, 0.0, 0.06))
    seen = []
    for before, distance_m in ((9, 0.5), (200, 3.0)):
        renderer.draw([Placed(before, facing(distance_m), EYE)], WHITE, camera(small(64, 48)))
        seen.append(renderer.draw([floor(), body], WHITE, view))
    for name in ("rgb", "depth_m", "region"):
        np.testing.assert_array_equal(*(getattr(one, name) for one in seen))
    assert (seen[0].region == 0).any() == (abs(inclination) < 0.5)


def test_shapes_and_framebuffers_on_the_gpu_are_bounded(renderer):
    first = shape_of(trimesh.creation.icosphere(1, 0.1))
    renderer.draw([Placed(3, first, translation(0, 0, 1))], APPEARANCE, camera(small(16, 16)))
    assert first in renderer._shapes
    held = [shape_of(trimesh.creation.icosphere(0, 0.1)) for _ in range(MAX_SHAPES)]
    for shape in held:
        renderer.draw([Placed(3, shape, translation(0, 0, 1))], APPEARANCE, camera(small(16, 16)))
    assert len(renderer._shapes) == MAX_SHAPES
    assert first not in renderer._shapes
    del held, shape
    for n in range(100):
        shape = shape_of(trimesh.creation.icosphere(1, 0.1))
        renderer.draw([Placed(3, shape, translation(0, 0, 1))], APPEARANCE, camera(small(16 + 8 * n, 512)))
    assert len(renderer._shapes) <= 2, "what only a scene held went with it"
    assert renderer._target.size == (16 + 8 * 99, 512), "one framebuffer is kept"


def test_memory_stays_flat_over_scenes_with_new_meshes(renderer, record_figure):
    """300 scenes, each with a new 5,000-face object and a new texture; the first 100 fill the stores."""
    texture = np.zeros((256, 256, 3), np.uint8)
    view, resident = camera(small(160, 120)), []
    for n in range(300):
        mesh = trimesh.creation.icosphere(4, 0.1)
        (part,) = facing(2.0).parts
        textured = Part("p", part.vertices, part.faces, Material(texture=texture.copy()), uv=part.vertices[:, :2])
        things = [Placed(3, shape_of(mesh), translation(0, 0, 1)), Placed(2, Shape((textured,)), EYE)]
        renderer.draw(things, APPEARANCE, view)
        renderer.count_pixels([things[0]], view)
        if n % 100 == 99:
            resident.append(resident_mib())
    growth = resident[2] - resident[1]
    record_figure("render memory growth over 100 scenes, MiB", "passed", growth, 8.0)
    assert growth < 8.0, f"resident memory, MiB: {resident}"


def resident_mib() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 2**20


WITHDRAWN = [
    *((FLAT, "flat", name) for name in ("rgb", "textures")),
    *((RASTER, "raster", name) for name in ("rgb", "shadows", "ambient_occlusion", "antialiasing", "textures")),
    *((RASTER, "raster", name) for name in ("transparency", "light_maps")),
    *((FOUR, "four samples", name) for name in ("rgb", "antialiasing", "samples")),
]


def with_holes(shape: Shape) -> Shape:
    """The upper half of each texture is clear."""
    parts = []
    for part in shape.parts:
        texture = part.material.texture
        if texture is not None:
            alpha = np.full((*texture.shape[:2], 1), 255, np.uint8)
            alpha[: len(alpha) // 2] = 0
            part = replace(part, material=replace(part.material, texture=np.dstack([texture[..., :3], alpha])))
        parts.append(part)
    return Shape(tuple(parts), shape.closed)


@pytest.mark.parametrize(("look", "tier", "name"), WITHDRAWN, ids=[f"{tier}-{name}" for _, tier, name in WITHDRAWN])
def test_an_effect_that_is_withdrawn_changes_colour_and_no_label(renderer, look: Look, tier: str, name: str):
    changed = False
    for seed in range(4):
        rng = np.random.default_rng(950 + seed)
        things, height = procedural_things(rng)
        things = [replace(thing, shape=with_holes(thing.shape)) for thing in things]
        for view in orbit_and_mirror(rng, height):
            full, less = (renderer.draw(things, APPEARANCE, view, *one) for one in (look, without(look, name)))
            assert full.depth_m.tobytes() == less.depth_m.tobytes()
            assert full.region.tobytes() == less.region.tobytes()
            assert (less.rgb is None) == (name == "rgb")
            changed |= less.rgb is None or not np.array_equal(full.rgb, less.rgb)
    assert changed


def test_drawing_again_gives_the_same_bytes_also_in_another_process(renderer):
    code = (
        "import hashlib, numpy as np\n"
        "from tests.workers.render.looks import FOUR, RASTER\n"
        "from tests.workers.render.random_scenes import *\n"
        "from workers.render.raster.gbuffer import shared_renderer\n"
        "rng = np.random.default_rng(31)\n"
        "things, height = procedural_things(rng)\n"
        "view = orbit_and_mirror(rng, height)[1]\n"
        "for look in (RASTER, FOUR):\n"
        "    rgb = shared_renderer().draw(things, APPEARANCE, view, *look).rgb\n"
        "    print(hashlib.sha256(rgb.tobytes()).hexdigest())\n"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    rng = np.random.default_rng(31)
    things, height = procedural_things(rng)
    view = orbit_and_mirror(rng, height)[1]
    for _ in range(2):
        mine = ""
        for look in (RASTER, FOUR):
            mine += hashlib.sha256(renderer.draw(things, APPEARANCE, view, *look).rgb.tobytes()).hexdigest() + "\n"
        assert mine == other
        renderer.draw(random_things(np.random.default_rng(5))[0], APPEARANCE, view, *FOUR)

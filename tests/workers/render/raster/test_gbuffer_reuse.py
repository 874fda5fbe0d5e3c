"""One renderer over many scenes: the same bytes, bounded stores, flat memory; and none where there is no OpenGL."""

import numpy as np
import pytest
import trimesh

from schemas.errors import MachineError
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
    random_things,
    shape_of,
    small,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import translation
from workers.render.raster.buffers import MAX_SHAPES
from workers.render.raster.context import open_context
from workers.render.raster.gbuffer import Renderer, shared_renderer


def test_drawing_again_gives_the_same_bytes(renderer):
    """Also after other scenes, other sizes, counts, and after the shapes were pushed out of the GPU's store."""
    rng = np.random.default_rng(21)
    things, height = random_things(rng)
    view = orbit_and_mirror(rng, height)[0]
    first = renderer.draw(things, APPEARANCE, view)
    for seed in range(30):
        others, _ = random_things(np.random.default_rng(100 + seed))
        renderer.draw(others, APPEARANCE, camera(small(100 + seed, 50), view.T_world_cam))
        renderer.count_pixels([others[-1]], view)
    again = renderer.draw(things, APPEARANCE, view)
    for name in ("rgb", "depth_m", "region"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes(), name


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


def test_what_is_returned_is_frozen_and_not_the_next_views(renderer):
    first = renderer.draw([floor()], WHITE, camera(T=orbit_pose(np.zeros(3), 0.8, 0.0, 2.5)))
    kept = first.rgb.copy(), first.depth_m.copy(), first.region.copy()
    renderer.draw([], APPEARANCE, camera())
    for image, copy in zip((first.rgb, first.depth_m, first.region), kept, strict=True):
        np.testing.assert_array_equal(image, copy)
        assert not image.flags.writeable and image.flags.c_contiguous


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


def test_the_shapes_of_a_scene_stay_on_the_gpu_between_its_views_however_many(renderer):
    shapes = [shape_of(trimesh.creation.icosphere(1, 0.1)) for _ in range(22)]
    things = [Placed(k, shape, translation(0.3 * k - 3.0, 0, 6)) for k, shape in enumerate(shapes, start=1)]
    renderer.draw(things, APPEARANCE, camera())
    for thing in things:
        renderer.count_pixels([thing], camera())
    assert all(shape in renderer._shapes for shape in shapes)
    del things[1:], shapes, thing
    renderer.draw(things, APPEARANCE, camera())
    assert len(renderer._shapes) == 1


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


def test_there_is_one_renderer_a_process(renderer):
    assert shared_renderer() is renderer
    assert renderer.name


def test_a_machine_without_gl_is_told_what_to_install(monkeypatch):
    def missing(name: str):
        raise ImportError("libEGL.so.1: cannot open shared object file")

    monkeypatch.setattr("workers.render.raster.context.importlib.import_module", missing)
    with pytest.raises(MachineError, match=r"libEGL.so.1.*apt-get install -y libgl1 libegl1 libgl1-mesa-dri"):
        open_context()
    with pytest.raises(MachineError):
        Renderer()

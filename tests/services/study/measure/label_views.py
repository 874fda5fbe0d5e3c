"""Made-up stored images of scenes whose views have a closed form."""

from types import SimpleNamespace

import numpy as np

from schemas.base import Range, frozen_array
from schemas.job.views import Images
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.shape import Appearance
from schemas.scene.view import Camera, Intrinsics, Pair, View
from services.job.job_file import validate_job
from services.study.images import Truth, measure_images
from tests.effects.scenes import SMALL, context_of, merged
from tests.kit.shapes import box, shape_of
from workers.geometry.camera import look_at
from workers.scene.context import Stopwatch
from workers.scene.make_scene import make_scene

UNITS = 5000.0
WIDTH, HEIGHT, F = 160, 120, 500.0
TOP_Z, TABLE_Z = 1.8, 2.0
ABOVE = np.array([0.0, 0.0, 2.0])
DARK = Appearance((0.0, 0.0, 0.0), (), (0.0, 0.0, 0.0))


def camera_above(width=WIDTH, height=HEIGHT, f=F) -> Camera:
    """Two metres above the table at z = 0, looking straight down: image x is the world's x, image y its -y."""
    k = Intrinsics(width=width, height=height, fx=f, fy=f, cx=width / 2, cy=height / 2)
    return Camera(k, frozen_array(look_at(ABOVE, np.zeros(3))))


def thing(region_id, mesh, T=None) -> Placed:
    return Placed(region_id, shape_of(mesh), frozen_array(np.eye(4) if T is None else T))


def table_and(*meshes) -> tuple[Placed, ...]:
    """A table that fills the image, its top at z = 0, and objects."""
    return (thing(2, box(4, 4, 0.02, (0, 0, -0.01))), *(thing(3 + i, mesh) for i, mesh in enumerate(meshes)))


def block(x=0.2, y=0.15, at=(0.0, 0.0)):
    """Its top is 0.2 m above the table: 1.8 m from the camera above."""
    return box(x, y, 0.2, (*at, 0.1))


def seen_of_block(camera, x=0.2, y=0.15, at=(0.0, 0.0)):
    """(depth in metres, region) by formula: from above a block at the axis shows its top alone."""
    k = camera.intrinsics
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    across, down = (u - k.cx) / k.fx * TOP_Z - at[0], (v - k.cy) / k.fy * TOP_Z + at[1]
    top = (np.abs(across) < x / 2) & (np.abs(down) < y / 2)
    return np.where(top, TOP_Z, TABLE_Z), np.where(top, 3, 2).astype(np.uint8)


def view(role, camera, depth_m, region) -> View:
    return View(role, 0, 0, camera, None, np.rint(depth_m * UNITS).astype(np.uint16), region, ())


def scene_of(things, *pairs, scene_id=5):
    plan = SimpleNamespace(scene_id=scene_id)
    return SimpleNamespace(plan=plan, posed=PosedScene(things, DARK), pairs=pairs)


def measure(things, *pairs, truth=None, units=UNITS):
    scene = scene_of(things, *pairs)
    context = SimpleNamespace(
        job=SimpleNamespace(images=Images(depth_units_per_m=units, depth_range_m=Range(0.2, 2.1)))
    )
    return measure_images(context, scene, truth or Truth(scene))


def pair_of(first, mirror=None, d_z_m=TOP_Z, aligned=None, projected=None, agreement=None) -> Pair:
    return Pair(d_z_m, first, aligned, mirror, projected, agreement, agreement)


def made(**changes):
    context = context_of(validate_job(merged(SMALL, changes), "a test"))
    return context, make_scene(context, 0, Stopwatch())

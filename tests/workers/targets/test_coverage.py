"""Alpha of studio scenes against many rays a pixel through the mesh itself, by another library; and the colour beneath it."""

from typing import cast

import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from schemas.scene.view import View
from tests.effects.scenes import make
from tests.kit.shapes import box
from tests.kit.tiers import first_of
from tests.workers.scene.test_cameras import alone
from workers.geometry.camera import NEAR_M

SIDE = 32
"""Rays along each side of a pixel."""


def open_sphere() -> trimesh.Trimesh:
    """A sphere without its upper half: thin walls, seen from inside and outside."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    return ball.submesh([np.flatnonzero(ball.triangles_center[:, 2] < 0.05)], append=True)


def needles() -> trimesh.Trimesh:
    """Rods thinner than a pixel, in several directions, and a box that some of them leave."""
    rods = []
    for number in range(12):
        rod = trimesh.creation.cylinder(radius=0.0012, height=0.6, sections=5)
        rod.apply_transform(trimesh.transformations.rotation_matrix(0.26 * number, [1.0, 0.3, 0.2]))
        rods.append(rod)
    return cast(trimesh.Trimesh, trimesh.util.concatenate([*rods, box(0.1, 0.1, 0.1)]))


MESHES = {
    "ball": (lambda: trimesh.creation.icosphere(subdivisions=3, radius=0.3), 1.0),
    "open": (open_sphere, 1.0),
    "cut": (lambda: box(0.9, 0.2, 0.25), 0.7),
    "near": (lambda: trimesh.creation.torus(0.5, 0.1), 0.3),
    "needles": (needles, 0.9),
}
"""A mesh and the distance of the cameras from its middle: cut and near leave the picture, and near surrounds them."""


def views_of(mesh: trimesh.Trimesh, distance_m: float, **changes: object) -> list[View]:
    """Six views over a sphere."""
    more = [{"name": "over", "sphere": {"count": 6, "pattern": "fibonacci", "radius_m": distance_m}}]
    made = make(alone(mesh, cameras={"more": more, "orbit": {"radius_m": 2.0}}, **changes))
    return [view for _, view in made.scene.views() if view.role == "over"]


def shares(mesh: trimesh.Trimesh, view: View, pixels: np.ndarray) -> np.ndarray:
    """[N]: the share of each pixel (row, column) of `pixels` [N, 2] whose rays, from the near plane on, meet the mesh."""
    k, T, rays = view.camera.intrinsics, view.camera.T_world_cam, RayMeshIntersector(mesh, scale_to_box=False)
    fine = (np.arange(SIDE) + 0.5) / SIDE
    v, u = (pixels[:, axis, None, None] + np.stack(np.meshgrid(fine, fine, indexing="ij"))[axis] for axis in (0, 1))
    along = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1).reshape(-1, 3) @ T[:3, :3].T
    return rays.intersects_any(T[:3, 3] + NEAR_M * along, along).reshape(len(pixels), -1).mean(axis=1)


@pytest.mark.parametrize("name", first_of(MESHES, 4))
def test_alpha_is_the_share_of_a_pixel_that_the_object_covers(name):
    build, distance_m = MESHES[name]
    mesh, partial, errors = build(), 0, []
    for view in views_of(mesh, distance_m):
        alpha, mask = view.rgb[..., 3], view.region > 0
        assert (alpha[mask] > 0).all() and (alpha[~mask] < 255).all()
        around = np.lib.stride_tricks.sliding_window_view(np.pad(mask, 1), (3, 3)).sum(axis=(2, 3))
        assert (alpha[around == 9] == 255).all()
        judged = np.argwhere(((around > 0) & (around < 9)) | ((alpha > 0) & (alpha < 255)))
        error = alpha[tuple(judged.T)] / 255.0 - shares(mesh, view, judged)
        errors.append(error)
        partial += len(judged)
    error = np.abs(np.concatenate(errors))
    assert partial > 200
    assert error.mean() < 1.0 / 64.0 and abs(np.concatenate(errors).mean()) < 1.0 / 256.0, (error.mean(), error.max())


@pytest.mark.parametrize("tier", ["flat", "raster"])
def test_colour_beneath_alpha_is_that_of_the_object(tier):
    for view in views_of(MESHES["ball"][0](), 1.0, render={"tier": tier}):
        rgb, alpha = view.rgb[..., :3].astype(int), view.rgb[..., 3]
        partial = (alpha > 0) & (alpha < 255)
        assert np.count_nonzero(partial) > 50 and not rgb[alpha == 0].any()
        assert rgb[partial].min() >= rgb[alpha == 255].min() - 2

"""A view with its pose and without its lens, and how squarely cameras see points of a surface past the surface itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture import CaptureCamera, CapturedView, DepthCorrection
from schemas.errors import CaptureError
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Mesh, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from workers.door.recordings.pictures import pinhole_maps, remap
from workers.geometry.camera import project
from workers.geometry.frames import invert, transform
from workers.geometry.jit import compiled
from workers.geometry.pixels import pixel_rays
from workers.geometry.projection import in_frame
from workers.geometry.raycast import Caster

Depth = NDArray[np.float32]
"""[H, W] z along the optical axis, metres, 0 where there is none."""


@dataclass(frozen=True, eq=False)
class PosedView:
    """The pictures of one view as pinholes see them, in the board frame.

    `camera` took rgb [H, W, 3] uint8 and mask [H, W] bool (None where none was given). `depth_camera` took depth_m [H, W]
    float32: it has the same intrinsics and stands where the estimate has the depth camera of the registered images.
    """

    number: int
    camera: Camera
    depth_camera: Camera
    rgb: NDArray[np.uint8]
    depth_m: Depth
    mask: NDArray[np.bool_] | None = None


def pose_view(view: CapturedView, camera: CaptureCamera, T_board_cam: Pose, depth: DepthCorrection) -> PosedView:
    """The view without its lens, its depth corrected. Raises CaptureError where it has no depth image."""
    if view.depth is None:
        raise CaptureError("no_depth", f"view {view.number} has no depth image: depth_{view.number:05d}.png is missing")
    k = camera.intrinsics
    rgb, stored, mask = view.rgb, view.depth, view.mask
    if camera.has_lens:
        maps = pinhole_maps(k, tuple(camera.lens.tolist()))
        rgb, stored = remap(rgb, maps, between=True), remap(stored, maps, between=False)
        mask = None if mask is None else remap(mask.view(np.uint8), maps, between=False).view(np.bool_)
    depth_m = correct_depth(stored, 1.0 / camera.depth_units_per_m, depth.scale, depth.offset_m)
    T_board_depth = frozen_array(T_board_cam @ depth.T_cam_depth)
    return PosedView(view.number, Camera(k, frozen_array(T_board_cam)), Camera(k, T_board_depth), rgb, depth_m, mask)


def correct_depth(stored: NDArray[np.uint16], metres: float, scale: float, offset_m: float) -> Depth:
    """[H, W] float32: stored depth in metres after a correction; 0 stays 0, and what is corrected to below 0 becomes 0."""
    of_code = np.maximum(np.arange(65_536) * metres * scale + offset_m, 0.0).astype(np.float32)
    of_code[0] = 0.0
    return of_code[stored]


def distort_mask(mask: NDArray[np.bool_], camera: CaptureCamera) -> NDArray[np.bool_]:
    """[H, W] bool: a pinhole's mask as the lens draws it, so that it fits the stored images."""
    if not camera.has_lens:
        return mask
    k, rays = camera.intrinsics, pixel_rays(camera.intrinsics, camera.lens)
    straight = (rays * [k.fx, k.fy] + [k.cx_opencv, k.cy_opencv]).astype(np.float32)
    return remap(mask.view(np.uint8), [straight[..., 0], straight[..., 1]], between=False).view(np.bool_)


def pinhole_rays(k: Intrinsics, shape: tuple[int, ...], stride: int = 1) -> tuple[Array, Array]:
    """(x [1, w], y [h, 1]) at z = 1 of the centre of every `stride`-th pixel of an image [H, W]."""
    rows, columns = (np.arange(stride // 2, side, stride, dtype=np.float64) + 0.5 for side in shape)
    return ((columns - k.cx) / k.fx)[None, :], ((rows - k.cy) / k.fy)[:, None]


CLEAR_M = 1e-5
"""A point is lifted off its face by so much before it is looked at, above float32's steps in the ray caster."""


@compiled
def pixel_of(
    T: Array, k: tuple[float, float, float, float], x: float, y: float, z: float
) -> tuple[float, float, float]:
    """(column, row, depth) of a point (x, y, z) after T [4, 4] by k (fx, fy, cx, cy); depth 0 where it is not in front."""
    depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if not depth > NEAREST_M:
        return 0.0, 0.0, 0.0
    column = k[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth + k[2]
    row = k[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth + k[3]
    return column, row, depth


NEAREST_M = 0.05
"""What is nearer to a camera is not seen by it."""


@compiled
def project_pixels(points: Array, T: Array, k: tuple[float, float, float, float]) -> Array:
    """[N, 3]: `pixel_of` of points [N, 3]."""
    pixels = np.empty((len(points), 3))
    for n in range(len(points)):
        pixels[n, 0], pixels[n, 1], pixels[n, 2] = pixel_of(T, k, points[n, 0], points[n, 1], points[n, 2])
    return pixels


def sample_pixels(
    rgb: NDArray[np.uint8], value_of: Array, camera: Camera, points: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """(values [N, 3], inside the image [N]) of an image at points [N, 3], bilinear; value_of [256]: of each code."""
    k = camera.intrinsics
    pixels = project_pixels(points, invert(camera.T_world_cam), (k.fx, k.fy, k.cx_opencv, k.cy_opencv))
    inside = (pixels[:, 2] > 0.0) & (pixels[:, :2] >= 0.0).all(axis=1)
    inside &= (pixels[:, :2] < [k.width - 1, k.height - 1]).all(axis=1)
    places, values = pixels[inside, :2], np.zeros((len(points), 3))
    column, row = np.floor(places).astype(np.int64).T
    s, t = (places - np.floor(places)).T[..., None]
    upper = value_of[rgb[row, column]] * (1.0 - s) + value_of[rgb[row, column + 1]] * s
    lower = value_of[rgb[row + 1, column]] * (1.0 - s) + value_of[rgb[row + 1, column + 1]] * s
    values[inside] = upper * (1.0 - t) + lower * t
    return values, inside


UNSEEN = -2.0
"""Stands for the cosine of a point that is not in the image."""


def best_cosine(
    caster: Caster,
    points: Array,
    normals: Array,
    cameras: Sequence[Camera],
    clear_m: float = CLEAR_M,
    least_cos: float = 0.0,
) -> Array:
    """[N]: how squarely points [N, 3] are seen past the caster's mesh, lifted along their unit normals by `clear_m`.

    The largest cosine between the normal and the way to a camera that sees the point; `UNSEEN` where none does, of those whose
    cosine is above `least_cos`: 0 for any angle from outside.
    """
    best = np.full(len(points), UNSEEN)
    if not len(points) or not len(cameras):
        return best
    positions, lifted = np.array([camera.position for camera in cameras]), points + clear_m * normals
    cosine = np.stack([facing_cosine(points, normals, camera) for camera in cameras])
    order = np.argsort(-cosine, axis=0, kind="stable")
    # Few calls, the cameras that face a point most first: those that see it are seldom asked again.
    for ranks in (order[:1], order[1:4], order[4:]):
        hidden = np.flatnonzero(best == UNSEEN)
        point, camera = np.tile(hidden, len(ranks)), ranks[:, hidden].ravel()
        asked = cosine[camera, point] > least_cos
        point, camera = point[asked], camera[asked]
        clear = caster.cast(lifted[point], positions[camera] - lifted[point])[0] > 1.0
        np.maximum.at(best, point[clear], cosine[camera[clear], point[clear]])
    return best


def facing_cosine(points: Array, normals: Array, camera: Camera) -> Array:
    """[N] cosine between the normal of points [N, 3] and the way to a camera, `UNSEEN` where they are not in its image."""
    seen = transform(invert(camera.T_world_cam), points)
    front = seen[:, 2] > NEAREST_M
    u, v = project(np.where(front[:, None], seen, [0.0, 0.0, 1.0]), camera.intrinsics)
    towards = camera.position - points
    cosine = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return np.where(front & in_frame(u, v, camera.intrinsics), cosine, UNSEEN)


def placed(mesh: Mesh) -> Placed:
    """The mesh as the ray caster takes it, in the frame that it is in."""
    return Placed(REGION_FIRST_OBJECT, Shape((Part("mesh", mesh.vertices, mesh.faces),)), np.eye(4))

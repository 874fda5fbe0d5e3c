"""Triangles drawn on a pixel grid without a GPU: z-buffers in float64, and the pixels that a shape covers as a GPU counts them.

`draw_triangles` is the z-buffer; depth images are registered to the colour camera beside them with it.

Coverage follows the arithmetic of OpenGL by llvmpipe: float32 from the shape's frame to window coordinates, vertices moved to
the nearest 1/256 pixel, and a pixel covered where its centre lies within a triangle, by exact integers. A centre on an edge
belongs to the triangle on its right or below. The last step to the window is a fused multiply and add, as processors with
FMA do it; here it is the same on those without.
"""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.capture import DepthCamera
from schemas.scene.shape import Mesh, Shape
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.frames import invert, transform
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.pixels import pixel_rays, project_points

STEEPEST = math.tan(math.radians(84.0))
"""Neighbouring pixels whose depth differs as on a surface seen at a larger angle of incidence lie on two surfaces.

At 1 m the Azure Kinect's narrow mode then has a step of 19 mm per pixel, some ten times its noise.
"""

ON_EDGE = 1e-9
"""A pixel centre so near to a triangle, pixels or shares of its area, is inside: rounding leaves no cracks."""


def register_depth(
    depth_m: Array,
    camera: DepthCamera,
    color: Intrinsics,
    color_lens: Array | None = None,
    max_step: float | None = None,
) -> Array:
    """[H, W] float64, metres: z at the pixel centres of the colour camera, 0 where nothing was measured.

    depth_m [h, w] is z at the pixel centres of the depth camera, 0 (or anything not positive and finite) for none. Each square
    of four neighbouring depth pixels becomes two triangles, which are drawn into the colour image; 1 / z is interpolated, so
    that planes stay planes, and the nearest surface wins. Squares whose depths differ by more than `max_step` times the nearest
    one lie across an edge and are left out, and so are squares with a corner without depth. The default `max_step` follows from
    `STEEPEST`. `color_lens` (OpenCV's order, [8]) is the lens of the colour image as stored; None for a pinhole.

    Raises ValueError where the image is not of the depth camera's size.
    """
    k = camera.intrinsics
    if depth_m.shape != (k.height, k.width):
        raise ValueError(f"the depth image is {depth_m.shape}, and its camera has {(k.height, k.width)}")
    step = STEEPEST / min(k.fx, k.fy) if max_step is None else max_step
    depth = np.ascontiguousarray(depth_m, np.float64)
    points = _lift(depth, pixel_rays(k, camera.lens), camera.T_color_depth)
    pixels = project_points(points, color, np.zeros(8) if color_lens is None else color_lens) - 0.5
    size = (color.height, color.width)
    drawn = draw_triangles(pixels, points[:, 2].copy(), _squares(pixels, depth, step), size, ON_EDGE, False)
    return drawn[0].astype(np.float64)


def draw_depth(mesh: Mesh, camera: Camera, near_m: float = 0.05) -> Array:
    """[H, W] float64: z of the nearest face at each pixel's centre, both sides of faces, 0 where there is none.

    Faces that reach nearer than `near_m` are left out.
    """
    k, points = camera.intrinsics, transform(invert(camera.T_world_cam), mesh.vertices)
    z = np.where(points[:, 2] > near_m, points[:, 2], np.nan)
    pixels = np.stack([k.fx * points[:, 0] / z + k.cx - 0.5, k.fy * points[:, 1] / z + k.cy - 0.5], axis=1)
    return draw_triangles(pixels, z, mesh.faces, (k.height, k.width), 0.0, True)[0].astype(np.float64)


@compiled
def _lift(depth_m: Array, rays: Array, T_color_depth: Array) -> Array:
    """[h * w, 3] float64: the depth image's points in the colour camera's frame; (0, 0, -1), behind it, where there is none."""
    T = T_color_depth
    points = np.empty((depth_m.size, 3))
    for i in range(depth_m.shape[0]):
        for j in range(depth_m.shape[1]):
            n, z = i * depth_m.shape[1] + j, depth_m[i, j]
            if z > 0.0 and math.isfinite(z) and math.isfinite(rays[i, j, 0]):
                x, y = rays[i, j, 0] * z, rays[i, j, 1] * z
                for axis in range(3):
                    points[n, axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
            else:
                points[n, 0], points[n, 1], points[n, 2] = 0.0, 0.0, -1.0
    return points


@compiled
def _squares(pixels: Array, depth_m: Array, max_step: float) -> NDArray[np.int32]:
    """[T, 3]: the two triangles of each square between four pixels of a depth image that lie on one surface, by number."""
    height, columns = depth_m.shape
    triangles, count = np.empty((2 * depth_m.size, 3), np.int32), 0
    for i in range(height - 1):
        for j in range(columns - 1):
            a, d = i * columns + j, (i + 1) * columns + j
            if math.isnan(pixels[a, 0] + pixels[a + 1, 0] + pixels[d, 0] + pixels[d + 1, 0]):
                continue
            z0, z1, z2, z3 = depth_m[i, j], depth_m[i, j + 1], depth_m[i + 1, j + 1], depth_m[i + 1, j]
            nearest = min(min(z0, z1), min(z2, z3))
            if max(max(z0, z1), max(z2, z3)) - nearest > max_step * nearest:
                continue
            triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, a + 1, d + 1
            triangles[count + 1, 0], triangles[count + 1, 1], triangles[count + 1, 2] = a, d + 1, d
            count += 2
    return triangles[:count]


Drawn = tuple[NDArray[np.floating], NDArray[np.int32]]
"""(z [H, W], metres, 0 where there is nothing; number of the triangle [H, W], -1 there)."""


@compiled
def draw_triangles(
    pixels: NDArray[np.floating],
    z: NDArray[np.floating],
    triangles: NDArray[np.int32],
    shape: tuple[int, int],
    slack: float,
    both_sides: bool,
) -> Drawn:
    """What of triangles [T, 3] is nearest at each pixel's centre, by a z-buffer; the first of equals.

    pixels [N, 2]: where points are in an image of `shape` (H, W), with the centres of pixels on whole numbers, nan for nowhere;
    z [N] > 0 along the optical axis, metres, interpolated as 1 / z, so that planes stay planes. A centre is inside up to `slack`,
    a share of the area, beyond an edge. Of triangles wound the other way than the image's axes are, nothing is drawn unless
    `both_sides` are.
    """
    height, width = shape
    depth, nearest = np.zeros(shape, z.dtype), np.full(shape, -1, np.int32)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ua, va, ub, vb, uc, vc = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if not (area > 0.0 or (both_sides and area < 0.0)):
            continue
        left = max(int(np.ceil(min(ua, ub, uc) - ON_EDGE)), 0)
        right = min(int(np.floor(max(ua, ub, uc) + ON_EDGE)), width - 1)
        top = max(int(np.ceil(min(va, vb, vc) - ON_EDGE)), 0)
        bottom = min(int(np.floor(max(va, vb, vc) + ON_EDGE)), height - 1)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                wb = ((x - ua) * (vc - va) - (uc - ua) * (y - va)) / area
                wc = ((ub - ua) * (y - va) - (x - ua) * (vb - va)) / area
                wa = 1.0 - wb - wc
                if wa < -slack or wb < -slack or wc < -slack:
                    continue
                at = 1.0 / (wa / z[a] + wb / z[b] + wc / z[c])
                if nearest[y, x] < 0 or depth[y, x] > at:
                    depth[y, x], nearest[y, x] = at, t
    return depth, nearest


@compiled
def corner_weights(pixels: NDArray[np.floating], triangles: NDArray[np.int32], nearest: NDArray[np.int32]) -> Array:
    """[H, W, 3] float64: the weights, sum 1, of the corners of the triangles [H, W] that `draw_triangles` found; 0 at none."""
    weights = np.zeros((*nearest.shape, 3))
    for y in range(nearest.shape[0]):
        for x in range(nearest.shape[1]):
            t = nearest[y, x]
            if t >= 0:
                a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                ua, va, ub, vb, uc, vc = (
                    pixels[a, 0],
                    pixels[a, 1],
                    pixels[b, 0],
                    pixels[b, 1],
                    pixels[c, 0],
                    pixels[c, 1],
                )
                area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
                weights[y, x, 1] = ((x - ua) * (vc - va) - (uc - ua) * (y - va)) / area
                weights[y, x, 2] = ((ub - ua) * (y - va) - (x - ua) * (vb - va)) / area
                weights[y, x, 0] = 1.0 - weights[y, x, 1] - weights[y, x, 2]
    return weights


NEAREST_M = 0.1
"""A shape that reaches nearer than this, along the optical axis, is not counted here: a near plane may cut it."""

LARGEST_PX = 1024
"""A shape that covers a wider or higher box than this is not counted here: the renderer counts it in tiles of this size."""

UNKNOWN = -1


def count_covered(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> int | None:
    """Pixels of the image's grid that the shape covers, also outside of the image, with nothing in front of it.

    None where it reaches nearer than `NEAREST_M`, further out of the image than one width or height of it, or over more than
    `LARGEST_PX` pixels.
    """
    camera = (k.fx, k.fy, k.cx, k.cy)
    T, size = np.ascontiguousarray(T_cam_shape), (k.width, k.height)
    count = _count_covered(shape.vertices, shape.faces, shape.closed, T, camera, size)
    return None if count == UNKNOWN else int(count)


@compiled_for("const(f8[:,::1]), const(i4[:,::1]), b1, f8[:,::1], UniTuple(f8, 4), UniTuple(i8, 2)")
def _count_covered(
    vertices: Array,
    faces: NDArray[np.int32],
    closed: bool,
    T: Pose,
    k: tuple[float, float, float, float],
    size: tuple[int, int],
) -> int:
    """The pixels, or `UNKNOWN`; k: fx, fy, cx, cy."""
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for n in range(len(vertices)):
        x, y, z = vertices[n, 0], vertices[n, 1], vertices[n, 2]
        Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if not Z > NEAREST_M:
            return UNKNOWN
        u = k[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / Z + k[2]
        v = k[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / Z + k[3]
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    if left < -size[0] or top < -size[1] or right > 2 * size[0] or bottom > 2 * size[1]:
        return UNKNOWN
    x0, y0 = int(np.floor(left)), int(np.floor(top))
    width, height = int(np.ceil(right)) - x0, int(np.ceil(bottom)) - y0
    if width > LARGEST_PX or height > LARGEST_PX:
        return UNKNOWN
    corners = to_grid(vertices, T.astype(np.float32), (k[0], k[1], k[2] - x0, k[3] - y0), width, height)
    covered = np.zeros((height, width), np.uint8)
    for face in range(len(faces)):
        area, a, b, c = oriented(corners, faces, face)
        # Of a closed body the faces towards the camera cover what all of them do.
        if area < 0 or (area > 0 and not closed):
            first, last, upper, lower = pixel_box(a, b, c, width, height)
            for row in range(upper, lower + 1):
                start, stop = covered_columns(a, b, c, row, first, last)
                if start <= stop:  # in one go: as a loop, each index is tested for counting from the end
                    covered[row, start : stop + 1] = 1
    pixels = 0
    for row in range(height):
        for column in range(width):
            pixels += covered[row, column]
    return pixels


@compiled
def to_grid(
    vertices: Array, T: NDArray[np.float32], k: tuple[float, float, float, float], width: int, height: int
) -> NDArray[np.int64]:
    """[V, 2]: where vertices fall in a window of this size, in 1/256 pixel from the centre of its first pixel."""
    x_by_X, x_by_Z = np.float32(2.0 * k[0] / width), np.float32(2.0 * k[2] / width - 1.0)
    y_by_Y, y_by_Z = np.float32(2.0 * k[1] / height), np.float32(2.0 * k[3] / height - 1.0)
    corners = np.empty((len(vertices), 2), np.int64)
    for n in range(len(vertices)):
        x, y, z = np.float32(vertices[n, 0]), np.float32(vertices[n, 1]), np.float32(vertices[n, 2])
        X = ((T[0, 0] * x + T[0, 1] * y) + T[0, 2] * z) + T[0, 3]
        Y = ((T[1, 0] * x + T[1, 1] * y) + T[1, 2] * z) + T[1, 3]
        Z = ((T[2, 0] * x + T[2, 1] * y) + T[2, 2] * z) + T[2, 3]
        inverse = np.float32(1.0) / Z
        corners[n, 0] = _snap((x_by_X * X + x_by_Z * Z) * inverse, width)
        corners[n, 1] = _snap((y_by_Y * Y + y_by_Z * Z) * inverse, height)
    return corners


@compiled
def _snap(share: np.float32, side: int) -> int:
    """A window coordinate from -1 to 1, in 1/256 pixel from the centre of the first of `side` pixels.

    The product of two float32 is exact in float64, so that one rounding to float32 remains, as in a fused operation.
    """
    pixel = np.float32(np.float64(share) * (0.5 * side) + 0.5 * side)
    return int(np.rint((pixel - np.float32(0.5)) * np.float32(256.0)))


Corner = tuple[int, int]


@compiled
def _cut_row(start: Corner, end: Corner, row: int, left: int, right: int) -> tuple[int, int]:
    """The pixels of a row, from `left` to `right`, whose centres lie within an edge; on the left and on top also those on it."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    # Within is where `inside` - 256 column dy > 0.
    inside = dx * (256 * row - start[1]) + dy * start[0] + (dy < 0 or (dy == 0 and dx > 0))
    if dy > 0 and inside <= 256 * dy * right:
        return left, (inside - 1) // (256 * dy)
    if dy < 0 and inside <= 256 * dy * left:
        return inside // (256 * dy) + 1, right
    return left, right if dy != 0 or inside > 0 else -1


@compiled
def oriented(corners: NDArray[np.int64], faces: NDArray[np.int32], face: int) -> tuple[int, Corner, Corner, Corner]:
    """(twice the area, positive where the face shows its back; its corners, clockwise)."""
    a, b, c = (
        (corners[faces[face, 0], 0], corners[faces[face, 0], 1]),
        (corners[faces[face, 1], 0], corners[faces[face, 1], 1]),
        (corners[faces[face, 2], 0], corners[faces[face, 2], 1]),
    )
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return (area, a, b, c) if area > 0 else (area, a, c, b)


@compiled
def pixel_box(a: Corner, b: Corner, c: Corner, width: int, height: int) -> tuple[int, int, int, int]:
    """(first, last column, upper, lower row) of the pixel centres in the triangle's box and in the image; no rows without any."""
    first, last = max((min(a[0], b[0], c[0]) + 255) >> 8, 0), min(max(a[0], b[0], c[0]) >> 8, width - 1)
    upper, lower = max((min(a[1], b[1], c[1]) + 255) >> 8, 0), min(max(a[1], b[1], c[1]) >> 8, height - 1)
    return first, last, upper, lower if first <= last else upper - 1


@compiled
def covered_columns(a: Corner, b: Corner, c: Corner, row: int, first: int, last: int) -> tuple[int, int]:
    """The columns of a row whose centres a triangle covers."""
    left, right = _cut_row(a, b, row, first, last)
    left, right = _cut_row(b, c, row, left, right)
    return _cut_row(c, a, row, left, right)

"""Effects of a real camera on a simulated photograph: samples, motion, depth noise, hidden markers, and the bend of a lens.

**Published.** Microsoft bounds the random error of depth by 17 mm and the systematic error by 11 mm + 0.1 % of the distance
over the whole range of the mode NFOV unbinned, 0.5 to 3.86 m. Tolgyessy et al. 2021 (Sensors 21(2):413) confirm both bounds
up to 3.5 m, find the noise lowest near the middle of the image and at short range, and describe pixels that fly between
a surface and what is behind it. Kurillo et al. 2022 (Sensors 22(7):2469) see the random error grow with the distance.

**Assumed.** The numbers of depth below are no fit of a published table. They are a device of the usual kind at arm's length,
far inside those bounds; what scenes have (schemas/job/views.py) is the upper bound.
"""

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.errors import CaptureError
from schemas.job.captures import Board, KinectDepthNoise, Simulate
from schemas.job.views import DepthNoise, Distortion
from schemas.scene.shape import Material, Part, Shape
from schemas.scene.view import Intrinsics
from workers.capture.board import marker_corners
from workers.geometry.colour import encode_codes, encode_srgb
from workers.geometry.frames import pose, rotation_about
from workers.geometry.jit import compiled
from workers.geometry.pixels import undistort

SAMPLES = 9
"""Images that are averaged into one photograph."""

DOWN, WHEN = (7, 0, 5, 2, 4, 6, 3, 8, 1), (6, 3, 0, 7, 4, 1, 8, 5, 2)
"""Row and moment of each sample, whose column is its number. No two of column, row and moment are correlated; samples n and
8 - n lie opposite one another; and of all such orders none spreads the points farther apart."""


@dataclass(frozen=True)
class Sample:
    """One image of the average: a point in the pixel, from its centre, and a moment of the exposure in [-0.5, 0.5]."""

    right_px: float
    down_px: float
    moment: float


CENTRE = Sample(0.0, 0.0, 0.0)
"""The sample of a picture that is antialiased already."""


def make_samples() -> tuple[Sample, ...]:
    """Nine samples with nine columns, nine rows and nine moments: an edge along a row or a column moves in steps of 1/9 px.

    Their mean is the pixel's centre at the exposure's middle, which is sample 4.
    """
    step = 1.0 / SAMPLES
    middle = (SAMPLES - 1) / 2
    return tuple(
        Sample((n - middle) * step, (down - middle) * step, (when - middle) * step)
        for n, (down, when) in enumerate(zip(DOWN, WHEN, strict=True))
    )


@compiled
def add_light(total: Array, rgb: NDArray[np.uint8], light_of: Array) -> None:
    """Adds the linear light of rgb [H, W, 3] to total [H, W, 3], in place; light_of [256]: of each code."""
    height, width = total.shape[:2]
    for row in range(height):
        for column in range(width):
            for channel in range(3):
                total[row, column, channel] += light_of[rgb[row, column, channel]]


@dataclass(frozen=True, eq=False)
class Motion:
    """Even motion in the camera's own axes: `way` [3] metres and a rotation by `turn_rad` about `axis` [3] in one exposure."""

    way: Array
    axis: Array
    turn_rad: float


SHARPEN_PX = 1.0
"""Standard deviation of the blur of the unsharp mask, as cameras have it."""

HAND_M_S, HAND_DEG_S = 0.15, 8.0
"""How fast a hand moves and turns a camera that it holds still."""

AT_REST = Motion(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0)


def draw_motion(time_s: float, rng: np.random.Generator) -> Motion:
    """A motion of the hand in its exposure or readout, in a uniform direction and about a uniform axis."""
    direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return Motion(HAND_M_S * time_s * direction, axis, math.radians(HAND_DEG_S) * time_s)


def pose_at(T_world_cam: Pose, motion: Motion, moment: float) -> Pose:
    """[4, 4]: the camera's pose at a moment, -0.5 to 0.5, of the exposure; T_world_cam is that of its middle."""
    return T_world_cam @ pose(rotation_about(motion.axis, moment * motion.turn_rad), moment * motion.way)


BANDS = 16
"""Bands of rows that are drawn from one pose each, where the camera moves while its rows are read."""


@dataclass(frozen=True)
class Band:
    """Rows [first, stop) and the moment of their middle, in [-0.5, 0.5] of the readout."""

    first: int
    stop: int
    moment: float


def bands_of(height: int, number: int, samples: int) -> tuple[Band, ...]:
    """The bands of one of so many samples: each has other bounds, so that the mean moment of a row is right to 1/18 of a band."""
    bounds = (np.arange(BANDS + 2) - (number + 0.5) / samples) / BANDS
    rows = np.unique(np.clip(np.rint(height * bounds), 0, height).astype(int)).tolist()
    return tuple(Band(a, b, (a + b) / (2 * height) - 0.5) for a, b in itertools.pairwise(rows))


def develop(light: Array, simulate: Simulate) -> NDArray[np.uint8]:
    """[H, W, 3] as the camera stores linear light [H, W, 3]: tone curve, then sharpening, then JPEG; sRGB without any."""
    tone, sharpen, jpeg = simulate.tone_curve, simulate.sharpen, simulate.jpeg
    codes = encode_codes(light)
    if tone is not None or sharpen is not None:
        value = np.clip(light, 0.0, 1.0) if tone is not None and tone.linear else encode_srgb(light)
        if tone is not None:
            value = value - tone.contrast * np.sin(2 * math.pi * value) / (2 * math.pi)
        if sharpen is not None:
            value = value + sharpen * (value - cv2.GaussianBlur(value, (0, 0), SHARPEN_PX))
        codes = np.rint(255 * np.clip(value, 0.0, 1.0)).astype(np.uint8)
    if jpeg is not None:
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(codes[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, jpeg])
        codes = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
    return codes


AXIAL_M, AXIAL_PER_M = 0.0008, 0.0005
"""sigma(z) = 0.8 mm + 0.5 mm z^2 (z in metres), over the cosine of incidence: 1.1 mm at 0.8 m and 1.3 mm at 1 m."""

OFFSET_M, OFFSET_SHARE = 0.0015, 0.001
"""bias(z) = 1.5 mm + 0.1 % of z: 2.3 mm at 0.8 m."""

STEP_M = 0.001
"""The device stores whole millimetres before anything is registered."""


def kinect_noise(spec: KinectDepthNoise) -> DepthNoise:
    """The settings of the depth sensor. `times` multiplies every random error, shares of pixels up to 1; `bias_m` is added.

    Edge mixing: of the pixels at a depth edge 0.3 fly between its surfaces and 0.2 have no depth; samples shift by 0.4 px.
    """
    usual = DepthNoise()
    return usual.model_copy(
        update={
            "axial_m": spec.times * AXIAL_M,
            "axial_per_m": spec.times * AXIAL_PER_M,
            "lateral_px": spec.times * usual.lateral_px,
            "flying_share": min(spec.times * usual.flying_share, 1.0),
            "edge_dropout": min(spec.times * usual.edge_dropout, 1.0),
            "offset_m": OFFSET_M + spec.bias_m,
            "offset_share": OFFSET_SHARE,
        }
    )


HEIGHT_M = 0.0003
"""Of a slip above the print: paper that does not lie quite flat."""

SIDE = (0.4, 0.8)
"""Shortest and longest side of a slip, in sides of a marker."""

YELLOW = (0.93, 0.86, 0.45, 1.0)
"""sRGB."""


def cover_markers(share: float, board: Board, rng: np.random.Generator) -> Shape | None:
    """Level slips in the board frame, metres, one over a part of each chosen marker; None where none is chosen."""
    corners = marker_corners(board)
    corners = corners[np.abs(corners[..., 2]).max(axis=1) == 0.0]  # those that lie on the board
    chosen = np.sort(rng.permutation(len(corners))[: round(share * len(corners))])
    if not len(chosen):
        return None
    slips = np.stack([_slip(corners[m], rng) for m in chosen])
    vertices = np.dstack([slips, np.full((*slips.shape[:2], 1), HEIGHT_M)]).reshape(-1, 3)
    first = 4 * np.arange(len(chosen))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Shape(
        (Part("slips", frozen_array(vertices), frozen_array(faces, np.int32), Material(YELLOW, roughness=1.0)),)
    )


def _slip(corners: Array, rng: np.random.Generator) -> Array:
    """[4, 2]: a turned rectangle whose middle lies on a marker; counter-clockwise from above."""
    side = float(np.linalg.norm(corners[1] - corners[0]))
    middle = corners.mean(axis=0)[:2] + side * rng.uniform(-0.5, 0.5, 2)
    half = 0.5 * side * rng.uniform(*SIDE, 2)
    turn = rng.uniform(0.0, math.pi)
    u, v = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    return np.stack([middle + a * half[0] * u + b * half[1] * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


MARGIN_PX = 2
"""Width of the wider picture beyond what the lens sees, for samples beside a pixel's centre."""

WIDEST = 2.0
"""A pinhole picture that must be more than so many times as wide or high belongs to no lens of this camera."""


def pinhole_lookup(lens: Distortion, k: Intrinsics) -> tuple[Intrinsics, Array, Array]:
    """(a pinhole camera that sees all that the lens does, u [H, W] and v [H, W] in its image of each stored pixel's centre).

    Raises CaptureError where the lens folds over within the image, or needs a picture more than `WIDEST` times as large.
    """
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    u, v = undistort(columns + 0.5, rows + 0.5, lens, k)
    if not (np.isfinite(u).all() and np.isfinite(v).all()):
        raise CaptureError("lens", f"the lens {lens} folds over within the image: make its coefficients smaller")
    left, top = math.floor(u.min()) - MARGIN_PX, math.floor(v.min()) - MARGIN_PX
    right, bottom = math.ceil(u.max()) + MARGIN_PX, math.ceil(v.max()) + MARGIN_PX
    if right - left > WIDEST * k.width or bottom - top > WIDEST * k.height:
        size = f"{right - left} x {bottom - top}"
        raise CaptureError("lens", f"the lens {lens} needs a pinhole picture of {size}: make its coefficients smaller")
    update = {"width": right - left, "height": bottom - top, "cx": k.cx - left, "cy": k.cy - top}
    return k.model_copy(update=update), u - left, v - top


@compiled
def add_bent_light(
    total: Array,
    rgb: NDArray[np.uint8],
    light_of: Array,
    lookup: tuple[Array, Array],
    offsets: tuple[float, float, float, float],
) -> None:
    """Adds linear light of a pinhole picture rgb [h, w, 3] seen through the lens to total [H, W, 3], in place.

    `lookup` is (u, v) of each stored pixel's centre. offsets: (right, down) of the sample from there in the stored image, by
    which the place moves with the lookup's slope, and (right, down) of the point that the picture has at its pixel centres.
    """
    u, v = lookup
    right, down, drawn_right, drawn_down = offsets
    height, width = total.shape[:2]
    for row in range(height):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(width):
            before, after = max(column - 1, 0), min(column + 1, width - 1)
            along, across = right / max(after - before, 1), down / max(below - above, 1)
            x = u[row, column] - drawn_right - 0.5
            x += along * (u[row, after] - u[row, before]) + across * (u[below, column] - u[above, column])
            y = v[row, column] - drawn_down - 0.5
            y += along * (v[row, after] - v[row, before]) + across * (v[below, column] - v[above, column])
            i, j = int(y), int(x)
            a, b = x - j, y - i
            for channel in range(3):
                p, q = light_of[rgb[i, j, channel]], light_of[rgb[i, j + 1, channel]]
                r, s = light_of[rgb[i + 1, j, channel]], light_of[rgb[i + 1, j + 1, channel]]
                upper, lower = p + a * (q - p), r + a * (s - r)
                total[row, column, channel] += upper + b * (lower - upper)

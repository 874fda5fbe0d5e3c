"""Detection of a board's markers in a photograph, with corners refined along their edges.

An edge is found on short profiles across it, at the centroid of the gradient of light, which blur moves less than it
moves the corner itself. Measured on pictures drawn in linear light and stored in sRGB: 0.04 px (rms an axis); OpenCV's
refinements leave 0.36 (AprilTag), 0.44 (cornerSubPix) and 0.85 (contour) there. On a real photograph it fits best of all,
0.23 px to a free homography against 0.28, once the side of the printed marker is free, as AprilTag's corners say as well.
"""

import itertools
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.capture import CaptureCamera, Detection
from schemas.job.captures import Board
from workers.capture.board import (
    LARGEST,
    PREDEFINED,
    Geometry,
    board_geometry,
    id_words,
    predefined_dictionary,
    smallest_dictionary,
)
from workers.geometry.colour import SRGB_STEPS
from workers.geometry.pixels import project_points, rays_of_pixels

SAMPLES = 24
"""Profiles across one edge."""
STEPS = 13
"""Places along one profile."""
MARGIN = 0.12
"""Share of an edge's length at each end that is left out, where the other edges disturb the profiles."""
MAX_HALF_PX = 4.0
MIN_HALF_PX = 1.5
"""Limits of half a profile's length."""
WINDOW = np.cos(0.5 * np.pi * np.linspace(-1, 1, 2 * STEPS - 1)[1::2]) ** 2
"""Weight of the gradient between two places of a profile, once the edge is in its middle. Light that changes beside one edge, as
where a cube stands on a table, moves the centroid by its distance: it moved edges by up to 0.2 px."""
ROUNDS = 5
"""Under its weight a centroid shows half of a shift where an edge is as wide as the weight: each round halves what is left."""
MAX_SHIFT = 1.0
"""A corner that moves by more than this many halves of a profile is kept as it was: the edge is not what it seemed."""
LINEAR = SRGB_STEPS.astype(np.float32)
"""[256]: light of each code. Blur adds up light: in codes the middle of a blurred edge lies 0.1 to 0.2 px on its dark side."""


def refine_corners(gray: NDArray[np.uint8], corners_px: Array, bits: float) -> Array:
    """[M, 4, 2] float64: corners [M, 4, 2] refined, pixel centres at integers as in OpenCV.

    `bits` is the marker's width in bits, its border included: a profile is shorter than the border is wide.
    """
    refined = np.array(corners_px, dtype=np.float64)
    if not len(refined):
        return refined
    light = LINEAR[gray]
    sides = np.linalg.norm(np.roll(refined, -1, axis=1) - refined, axis=2).min(axis=1)
    half_px = np.clip(0.5 * sides / bits, MIN_HALF_PX, MAX_HALF_PX)
    largest = np.broadcast_to(MAX_SHIFT * half_px[:, None], refined.shape[:2])
    for turn in range(ROUNDS):
        lines = _edge_lines(light, refined, half_px, only_rising=turn == 0)
        met = _intersections(lines)
        shift = np.linalg.norm(met - refined, axis=2)
        near = shift <= largest
        refined = np.where(near[..., None], met, refined)  # no shift to where two lines do not meet is near
        # A corner that moves farther than in the round before is drawn to another edge.
        largest = np.where(near & (turn > 0), shift, largest)
    return refined


def _edge_lines(light: NDArray[np.float32], corners: Array, half_px: Array, only_rising: bool) -> Array:
    """[M, 4, 3]: line a x + b y = c with unit (a, b), from each corner to the next."""
    along = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(along, axis=2, keepdims=True)
    along = along / length
    across = np.stack([along[..., 1], -along[..., 0]], axis=2)  # out of the marker: its corners run clockwise
    place = np.linspace(MARGIN, 1 - MARGIN, SAMPLES) * length  # [M, 4, S]
    steps = np.linspace(-1, 1, STEPS) * half_px[:, None]  # [M, P]
    base = corners[:, :, None] + place[..., None] * along[:, :, None]
    points = base[:, :, :, None] + steps[:, None, None, :, None] * across[:, :, None, None]
    flat = points.reshape(-1, SAMPLES * STEPS, 2).astype(np.float32)
    profile = cv2.remap(light, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    bright = profile.reshape(points.shape[:-1]).astype(np.float64)
    gradient = np.diff(bright, axis=3)
    between = 0.5 * (steps[:, 1:] + steps[:, :-1])[:, None, None]
    if (
        only_rising
    ):  # what lies beyond the white of the gap must not count; noise, brighter outside, moves the centroid then
        weight, offset = _centroid(np.maximum(gradient, 0.0), between)
    else:  # a halo moves all edges alike, and what it does to whole profiles is kept
        weight, offset = _centroid(gradient * WINDOW, between)
        offset = offset + np.median(_centroid(gradient, between)[1] - offset)
    weight = np.where(weight > 0.5 * np.median(weight, axis=2, keepdims=True), weight, 0.0)
    shift, slope = _robust_lines(place - 0.5 * length, offset, weight, half_px)
    normal = across - slope[..., None] * along
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    middle = corners + 0.5 * length * along + shift[..., None] * across
    return np.concatenate([normal, (normal * middle).sum(axis=2, keepdims=True)], axis=2)


def _centroid(gradient: Array, place: Array) -> tuple[Array, Array]:
    """(sum of a gradient [..., P], at least 0, and its centroid among places [..., P])."""
    total = np.maximum(gradient.sum(axis=-1), 0.0)
    return total, np.clip((gradient * place).sum(axis=-1) / np.maximum(total, 1e-9), -1e3, 1e3)


def _robust_lines(place: Array, offset: Array, weight: Array, half_px: Array) -> tuple[Array, Array]:
    """(shift, slope), each [M, 4]: lines offset = shift + slope place through samples [M, 4, S], Cauchy weights."""
    scale = 0.05 * half_px[:, None, None]
    robust = np.ones_like(offset)
    shift, slope = np.median(offset, axis=2), np.zeros(offset.shape[:2])
    for _ in range(4):
        residual = offset - shift[..., None] - slope[..., None] * place
        robust = weight / (1.0 + (residual / scale) ** 2) + 1e-12
        total = robust.sum(axis=2)
        x, y = (robust * place).sum(axis=2) / total, (robust * offset).sum(axis=2) / total
        dx = place - x[..., None]
        slope = (robust * dx * (offset - y[..., None])).sum(axis=2) / (robust * dx * dx).sum(axis=2)
        shift = y - slope * x
    return shift, slope


def _intersections(lines: Array) -> Array:
    """[M, 4, 2]: corner k is where edge k - 1 and edge k meet."""
    before = np.roll(lines, 1, axis=1)
    (a, b, c), (d, e, f) = np.moveaxis(before, 2, 0), np.moveaxis(lines, 2, 0)
    det = a * e - b * d
    det = np.where(np.abs(det) < 1e-6, np.nan, det)
    return np.stack([(c * e - b * f) / det, (a * f - c * d) / det], axis=2)


def unbend_corners(corners_px: Array, camera: CaptureCamera) -> Array:
    """[M, 4, 2]: refined corners [M, 4, 2], centres at +0.5, without what a lens that bends their edges does to them.

    Where two lines through curved edges meet is not where the edges do; the difference is that of straight edges drawn
    through the same lens. nan where the lens has no ray.
    """
    rays = rays_of_pixels(corners_px.reshape(-1, 2), camera.intrinsics, camera.lens).reshape(-1, 4, 2)
    place = np.linspace(MARGIN, 1 - MARGIN, SAMPLES)[:, None]
    edges = rays[:, :, None] * (1 - place) + np.roll(rays, -1, axis=1)[:, :, None] * place
    points = np.concatenate([edges, np.ones((*edges.shape[:3], 1))], axis=3).reshape(-1, 3)
    drawn = project_points(points, camera.intrinsics, camera.lens).reshape(edges.shape)
    middle = drawn.mean(axis=2)
    along = drawn[:, :, -1] - drawn[:, :, 0]
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=2)
    x, y = (((drawn - middle[:, :, None]) * axis[:, :, None]).sum(axis=3) for axis in (along, normal))
    normal = normal - ((x * y).sum(axis=2) / (x * x).sum(axis=2))[..., None] * along
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    met = _intersections(np.concatenate([normal, (normal * middle).sum(axis=2, keepdims=True)], axis=2))
    return np.asarray(2 * corners_px - met, np.float64)


MIN_PERIMETER = 0.01
"""Smallest perimeter of a marker over the larger side of the image: 19 px of 1920, below which bits cannot be read."""
SEVERAL = 4
"""Another dictionary is named for so many markers: fewer may be chance."""


def detect_markers(
    rgb: NDArray[np.uint8], board: Board, dictionary: "cv2.aruco.Dictionary", camera: CaptureCamera, number: int = 0
) -> Detection:
    """The board's markers in an image [H, W, 3]. Where several prints of the board are in view each has its own, `others`.

    Ids that are not on the board are dropped, and markers seen twice where they do not tell two prints apart.
    """
    geometry = board_geometry(board)
    gray, quads, ids = _find_quads(rgb, dictionary, board.border_bits)
    values, counts = np.unique(ids, return_counts=True)
    known = np.isin(values, geometry.ids)
    dropped = [f"marker {n} is not on the board ({id_words(geometry.ids)})" for n in values[~known]]
    dropped += [f"marker {n} was seen {count} times" for n, count in zip(values, counts, strict=True) if count > 1]
    kept = np.flatnonzero(np.isin(ids, values[known]))
    kept = kept[np.argsort(ids[kept], kind="stable")]
    ids, corners = ids[kept], refine_corners(gray, quads[kept], dictionary.markerSize + 2 * board.border_bits)
    prints = [np.flatnonzero(np.isin(ids, values[counts == 1]))]
    if len(prints[0]) < len(ids):
        prints = split_prints(ids, corners + 0.5, geometry, camera) or prints
    made = []
    for chosen in prints:
        chess, chess_px = _find_chess(gray, geometry, ids[chosen], corners[chosen])
        marks, chess_px = frozen_array(corners[chosen] + 0.5), frozen_array(chess_px + 0.5)
        made.append(Detection(number, ids[chosen], marks, tuple(dropped), chess, chess_px))
    return replace(made[0], others=tuple(made[1:]))


LEAST_PRINT = 4
"""Markers that tell a print."""
BESIDE_SIDES = 0.5
"""A marker belongs to a print whose pose puts its corners at most so many of a usual marker's sides away."""
EXPLAINED = 0.8
"""Share of all markers that prints of one board explain: what lies otherwise is another board."""
DRAWS = 1000
"""Random poses by three corners, and a fourth, of which the one that explains most is a print's (RANSAC, from a fixed seed)."""


def split_prints(
    ids: NDArray[np.int64], corners_px: Array, geometry: Geometry, camera: CaptureCamera
) -> list[NDArray[np.intp]]:
    """Which of markers [M], with corners [M, 4, 2] at +0.5, are on each print of a board in view, most first; ids may repeat.

    A print is what one pose explains. Empty where prints of this board do not explain the markers.
    """
    rays = rays_of_pixels(corners_px.reshape(-1, 2), camera.intrinsics, camera.lens).reshape(-1, 4, 2)
    places, sides = geometry.corners[geometry.index(ids)], np.linalg.norm(rays[:, 1] - rays[:, 0], axis=1)
    left, prints = np.flatnonzero(np.isfinite(rays).all(axis=(1, 2))), []
    while len(left) >= LEAST_PRINT:
        explained = cv2.solvePnPRansac(
            places[left].reshape(-1, 3),
            rays[left].reshape(-1, 2),
            np.eye(3),
            None,
            iterationsCount=DRAWS,
            reprojectionError=BESIDE_SIDES * float(np.median(sides[left])),
            confidence=0.9999,
            flags=cv2.SOLVEPNP_AP3P,
        )[3]
        corners = np.zeros(0, np.int64) if explained is None else explained.ravel()
        of_print = left[np.bincount(corners // 4, minlength=len(left)) == 4]
        if len(of_print) < LEAST_PRINT:
            break
        prints.append(of_print)
        left = np.setdiff1d(left, of_print)
    return prints if sum(map(len, prints)) >= EXPLAINED * len(ids) else []


def find_markers(
    rgb: NDArray[np.uint8], dictionary: "cv2.aruco.Dictionary", border_bits: int
) -> tuple[NDArray[np.int64], Array]:
    """(ids [M], corners [M, 4, 2], centres at +0.5) of all markers of a dictionary, but those that are seen twice."""
    gray, quads, ids = _find_quads(rgb, dictionary, border_bits)
    values, counts = np.unique(ids, return_counts=True)
    once = np.isin(ids, values[counts == 1])
    return ids[once], refine_corners(gray, quads[once], dictionary.markerSize + 2 * border_bits) + 0.5


def _find_quads(
    rgb: NDArray[np.uint8], dictionary: "cv2.aruco.Dictionary", border_bits: int
) -> tuple[NDArray[np.uint8], Array, NDArray[np.int64]]:
    """(grey image, [N, 4, 2] corners as OpenCV has them, pixel centres at integers, [N] ids)."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)
    quads, ids, _ = _detector(dictionary, border_bits).detectMarkers(gray)
    return gray, np.array(quads, np.float64).reshape(-1, 4, 2), np.array([] if ids is None else ids, np.int64).ravel()


NEAR_MARKERS = 4
"""A square is looked for where so many of the nearest markers put it: farther ones know less of the lens."""
CHESS_REACH = 1.5
"""Farthest marker that tells of a square, in sides of it."""
BESIDE = 0.6
"""Where light is looked at to tell a corner, as a share of the way to the nearest marker."""
CONTRAST = 0.3
"""Least difference of light between white and black at a corner, over that of the brightest and the darkest there."""
UNEVEN_PX = 0.5
"""Two squares whose corners are apart by so much more or less than usual in the image: something hides one of them."""
DARK = 0.02
"""Least difference of light, of 1, that is more than noise."""


def _find_chess(
    gray: NDArray[np.uint8], geometry: Geometry, ids: NDArray[np.int64], corners_px: Array
) -> tuple[NDArray[np.int64], Array]:
    """([K] which corners of the chessboard are seen, [K, 2] where), pixel centres at integers as in OpenCV.

    ids [M] and corners_px [M, 4, 2] are the markers found. The two black squares at a corner are refined as markers are, and
    the corner is in the middle between theirs: ink that spreads moves them apart by as much.
    """
    none = np.zeros(0, np.int64), np.zeros((0, 2))
    if not (len(geometry.chess) and len(ids)):
        return none
    markers = geometry.corners[geometry.index(ids)]
    start = np.stack([_near_homography(square, square, markers, corners_px) for square in geometry.squares])
    known = np.isfinite(start).all(axis=(1, 2))
    side_m = np.linalg.norm(geometry.squares[0, 1] - geometry.squares[0, 0])
    start[known] = refine_corners(gray, start[known], float(0.5 * side_m / geometry.chess_free_m.min()))
    pairs = start[geometry.chess_squares, geometry.chess_corners]  # [K, 2, 2]
    places, light = pairs.mean(axis=1), LINEAR[gray]
    seen = [n for n in range(len(places)) if _is_corner(light, pairs[n], _beside(n, geometry, markers, corners_px))]
    if not seen:
        return none
    gaps = np.linalg.norm(pairs[seen, 1] - pairs[seen, 0], axis=1)
    chosen = np.array(seen)[np.abs(gaps - np.median(gaps)) <= UNEVEN_PX]
    return chosen, places[chosen]


def _near_homography(points: Array, square: Array, markers: Array, corners_px: Array) -> Array:
    """[N, 2] pixels of points [N, 3] in the plane of a square [4, 3], by the markers near it; nan without any."""
    x, y = square[1] - square[0], square[3] - square[0]
    side = float(np.linalg.norm(x))
    distance = np.linalg.norm(markers.mean(axis=1) - square.mean(axis=0), axis=1)
    near = np.argsort(distance, kind="stable")[:NEAR_MARKERS]
    near = near[distance[near] < CHESS_REACH * side]
    axes = np.stack([x, y], axis=1) / side
    H = None
    if len(near):
        flat = (markers[near].reshape(-1, 3) - square[0]) @ axes
        H, _ = cv2.findHomography(flat, corners_px[near].reshape(-1, 2))
    if H is None:
        return np.full((len(points), 2), np.nan)
    return cv2.perspectiveTransform(((points - square[0]) @ axes)[None], H)[0].astype(np.float64)


def _beside(number: int, geometry: Geometry, markers: Array, corners_px: Array) -> Array:
    """[5, 2] pixels: a corner of the chessboard, two points beside it in its black squares, and two in its white ones."""
    at, squares = geometry.chess[number], geometry.squares[geometry.chess_squares[number]]
    x, y = (squares[0, k] - squares[0, 0] for k in (1, 3))
    to_black = squares.mean(axis=1) - at
    to_white = to_black - 2.0 * np.outer(to_black @ y, y) / (y @ y)
    reach = BESIDE * geometry.chess_free_m[number] / (0.5 * np.linalg.norm(x))
    points = at + np.concatenate([np.zeros((1, 3)), reach * to_black, reach * to_white])
    return _near_homography(points, squares[0], markers, corners_px)


def _is_corner(light: NDArray[np.float32], pair: Array, points: Array) -> bool:
    """Whether the light about the middle of a pair [2, 2] is a chessboard's; points [5, 2] as in `_beside`."""
    height, width = light.shape
    inside = (points >= 0).all() and (points < [width - 1, height - 1]).all()  # false of nan
    if not (inside and np.isfinite(pair).all()):
        return False
    free_px = float(np.linalg.norm(points[1:] - points[0], axis=1).min()) / (BESIDE * 2.0**0.5)
    off_px = max(np.linalg.norm(pair.mean(axis=0) - points[0]), np.linalg.norm(pair[1] - pair[0]))
    u, v = (points[1:] - points[0] + pair.mean(axis=0)).astype(np.float32).T[..., None]
    seen = cv2.remap(light, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    apart = float(seen[2:].min() - seen[:2].max())
    return free_px >= MIN_HALF_PX and off_px < free_px and apart > max(CONTRAST * float(np.ptp(seen)), DARK)


def other_dictionary(rgb: NDArray[np.uint8]) -> tuple[str, str, int]:
    """(what markers the image holds, in words; the largest dictionary of their family; bits of their border); or nothing.

    Mirrored markers have no dictionary. Takes a second or two: for the message about a capture without a usable pose.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    best, most = ("", "", 1), SEVERAL - 1
    pictures = ((gray, ""), (np.ascontiguousarray(gray[:, ::-1]), ", mirrored"))
    names = {name.upper(): name for name in PREDEFINED}.values()  # some have two
    for name, (picture, how), border_bits in itertools.product(names, pictures, (1, 2)):
        if name != smallest_dictionary(name, LARGEST) or (border_bits > 1 and "APRILTAG" not in name):
            continue  # the first markers of the dictionary of 1000; two bits are Kalibr's
        _, ids, _ = _detector(predefined_dictionary(name), border_bits).detectMarkers(picture)
        if ids is not None and len(ids) > most:
            smallest, most = smallest_dictionary(name, int(np.median(ids))), len(ids)  # a few ids may be misread
            best = f"the image holds {most} markers of {smallest}{how}", "" if how else name, border_bits
    return best


def _detector(dictionary: "cv2.aruco.Dictionary", border_bits: int) -> "cv2.aruco.ArucoDetector":
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    settings.minMarkerPerimeterRate = MIN_PERIMETER
    settings.markerBorderBits = border_bits
    return cv2.aruco.ArucoDetector(dictionary, settings)

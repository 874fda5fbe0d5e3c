"""What a level top hides of the thing below it, as a table's top hides its legs: pure functions.

Fragments compute their own depth (gbuffer.py), so hidden ones are shaded before they are tested. What lies below a convex
top, and is seen through the inside of it by all its corners, is hidden whole and need not be drawn.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled

BELOW_M = 1e-3
"""What a top hides is at least so far below it: ten times as far as the heights of its points differ."""

INSIDE = 2e-3
"""What a top hides is seen this share of its distance inside of its outline: a rasteriser moves edges by 1/256 pixel."""

OUT_OF_LINE_M = 1e-6
"""Corners may lie so far outside of an edge of the outline: float32 has this for a metre."""

LEAST_SINE = 0.1
"""Least sine of the elevation from which a top is taken to hide anything."""

MERGED = 24
"""Hidden triangles between two that are seen, up to this number, are drawn too: a draw call costs more."""


@dataclass(frozen=True, eq=False)
class Cover:
    """A convex, level top without holes, in its thing's frame.

    `level_m`: its height. sides [E, 3]: unit (a, b), and c, where a x + b y + c < 0 inside, metres.
    """

    level_m: float
    sides: Array


def find_cover(triangles: NDArray[np.float32]) -> Cover | None:
    """The cover that triangles [F, 3, 3] on one level, counter-clockwise from above, make together; None where they make none.

    Edges that no other triangle has in the opposite direction are the outline. Where every corner lies to the left of all of
    them, they are a convex polygon, and the triangles fill it.
    """
    if not len(triangles):
        return None
    corners = [[tuple(corner) for corner in triangle] for triangle in triangles[:, :, :2].tolist()]
    edges = {(a, b) for p, q, r in corners for a, b in ((p, q), (q, r), (r, p)) if a != b}
    outline = np.array([edge for edge in edges if edge[::-1] not in edges]).reshape(-1, 2, 2)
    along = outline[:, 1] - outline[:, 0]
    length = np.hypot(along[:, 0], along[:, 1])
    outwards = np.column_stack([along[:, 1], -along[:, 0]]) / length[:, None]
    sides = np.column_stack([outwards, -(outwards * outline[:, 0]).sum(axis=1)])
    points = np.array([corner for triangle in corners for corner in triangle])
    if not len(sides) or (points @ sides[:, :2].T + sides[:, 2]).max() > OUT_OF_LINE_M:
        return None
    return Cover(float(triangles[..., 2].max()), sides)


def seen_ranges(
    positions: NDArray[np.float32], faces: NDArray[np.uint32], cover: Cover, eye: Array
) -> list[tuple[int, int]]:
    """(first, count) of the runs of faces [F, 3] that a cover may not hide from an eye [3]; positions [V, 3]; its frame."""
    starts = np.empty((len(faces) + 1, 2), np.int64)
    count = _seen_ranges(positions, faces, cover.level_m, cover.sides, eye, starts)
    return [(first, end - first) for first, end in starts[:count].tolist()]


@compiled
def _seen_ranges(
    positions: NDArray[np.float32],
    faces: NDArray[np.uint32],
    level_m: float,
    sides: Array,
    eye: Array,
    ranges: NDArray[np.int64],
) -> int:
    """Fills ranges [F, 2] with the first face and the end of each run, and returns their number."""
    hidden = np.zeros(len(positions), np.bool_)
    above = eye[2] - level_m
    for n in range(len(positions)):
        below = level_m - positions[n, 2]
        if above <= 0.0 or below < BELOW_M:
            continue
        share = above / (above + below)  # of the way from the eye, where the top's level is met
        dx, dy = share * (positions[n, 0] - eye[0]), share * (positions[n, 1] - eye[1])
        away_m = np.sqrt(dx * dx + dy * dy + above * above)
        inside = above >= LEAST_SINE * away_m
        for side in range(len(sides)):
            if not inside:
                break
            out = sides[side, 0] * (eye[0] + dx) + sides[side, 1] * (eye[1] + dy) + sides[side, 2]
            inside = out < -INSIDE * away_m
        hidden[n] = inside
    count = 0
    for face in range(len(faces)):
        if hidden[faces[face, 0]] and hidden[faces[face, 1]] and hidden[faces[face, 2]]:
            continue
        if count and face - ranges[count - 1, 1] <= MERGED:
            ranges[count - 1, 1] = face + 1
        else:
            ranges[count, 0], ranges[count, 1] = face, face + 1
            count += 1
    return count

"""Slips of paper that lie on the print and hide markers in part."""

import math

import numpy as np

from schemas.base import Array, frozen_array
from schemas.job.captures import Board, HiddenMarkers
from schemas.scene.shape import Material, Part, Shape
from workers.capture.board.layout import marker_corners

HEIGHT_M = 0.0003
"""Of a slip above the print: paper that does not lie quite flat."""

SIDE = (0.4, 0.8)
"""Shortest and longest side of a slip, in sides of a marker."""

YELLOW = (0.93, 0.86, 0.45, 1.0)
"""sRGB."""


def cover_markers(hidden: HiddenMarkers, board: Board, rng: np.random.Generator) -> Shape | None:
    """Level slips in the board frame, metres, one over a part of each chosen marker; None where none is chosen."""
    corners = marker_corners(board)
    chosen = np.sort(rng.permutation(len(corners))[: round(hidden.share * len(corners))])
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

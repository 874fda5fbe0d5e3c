"""Pure: solids swept from an outline: prisms with round edges, and bent rods."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from schemas.base import Array
from workers.assets.builtin.curves import directions, rounded_rectangles
from workers.assets.builtin.solid import Indices, Solid, loft, smoothing_groups


def prism(
    profile: Array,
    size: tuple[float, float],
    radius: float,
    surface: Sequence[int] | Indices,
    steps: int = 3,
    sides: tuple[int, int] = (1, 1),
) -> Solid:
    """A box with round upright edges: `profile` [L, 2] of (inset, height) from its bottom to its top, metres.

    size: width along x and depth along y where the inset is 0; surface: one number for the bottom, each band, the top.
    Raises ValueError where the sides have no room for the round edges: that is a bug of the caller's.
    """
    inset, z = profile[:, 0], profile[:, 1]
    if (0.5 * min(size) - inset < np.maximum(radius - inset, 2e-4)).any():
        raise ValueError(f"a prism of {size} with edges of radius {radius} has no room for an inset of {inset.max()}")
    outline = rounded_rectangles(np.array(size) - 2.0 * inset[:, None], np.maximum(radius - inset, 2e-4), steps, sides)
    rings = np.empty((*outline.shape[:2], 3))
    rings[..., :2], rings[..., 2] = outline, z[:, None]
    ends = np.array([[0.0, 0.0, z[0]], [0.0, 0.0, z[-1]]])
    reach = np.array([[size[1], 0.0]])
    closed = np.concatenate([profile[:1] + reach, profile, profile[-1:] + reach])
    profiles = np.zeros((2, len(profile) + 2, 2))
    profiles[:, 1:-1, 0], profiles[..., 1] = 0.5 * np.array(size)[:, None] - inset, z[[0, *range(len(z)), -1]]
    return loft(rings, ends[0], ends[1], surface, smoothing_groups(closed), profiles)


def straight_prism(
    size: tuple[float, float], low: float, high: float, radius: float, surface: int, steps: int = 1
) -> Solid:
    """A prism of one size and surface number between two heights."""
    return prism(np.array([[0.0, low], [0.0, high]]), size, radius, [surface] * 3, steps)


def bevelled_profile(height: float, bevel: float, bottom: float = 0.0) -> Array:
    """[4, 2] float64: the (inset, height) profile of a slab from `bottom`, with a bevel along its upper and lower edge."""
    top = bottom + height
    return np.array([[bevel, bottom], [0.0, bottom + bevel], [0.0, top - bevel], [bevel, top]])


def bend_radius(path: Array, ends: tuple[Array, Array]) -> float:
    """The largest half thickness, metres, of a rod along a path [K, 2] that does not fold at its tightest bend."""
    step, turn = np.diff(path, axis=0), np.diff(directions(path, ends), axis=0)
    length, bend = (np.sqrt(v[:, 0] ** 2 + v[:, 1] ** 2) for v in (step, turn))
    return float((length / np.maximum(bend, 1e-9)).min())


def rod(path: Array, section: Array, surface: int, ends: tuple[Array, Array], swell: Array | None = None) -> Solid:
    """A rod bent along a path [K, 2] in the xz plane; section [n, 2]: across (along y) and in the plane of the path.

    ends: the unit directions (x, z) in which the path begins and ends; swell [K]: factor on the section.
    """
    tangent = directions(path, ends)
    factor = np.ones(len(path)) if swell is None else swell
    u, v = section[:, 0] * factor[:, None], section[:, 1] * factor[:, None]
    x = path[:, 0:1] - tangent[:, 1:2] * v
    z = path[:, 1:2] + tangent[:, 0:1] * v
    rings = np.stack([x, u, z], axis=2)
    caps = [np.array([path[k, 0], 0.0, path[k, 1]]) for k in (0, -1)]
    smooth = np.array([0, *[1] * (len(path) - 1), 2])
    return loft(rings, caps[0], caps[1], np.full(len(path) + 1, surface), smooth)


def split_sides(solid: Solid, surface: int, numbers: tuple[int, int, int, int]) -> Solid:
    """The solid with one surface split into four by the direction of its faces: front (-y), right (+x), back (+y), left (-x)."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    x, y, _ = np.cross(b - a, c - a).T
    side = np.where(np.abs(y) >= np.abs(x), np.where(y < 0, 0, 2), np.where(x > 0, 1, 3))
    chosen = solid.surface == surface
    return replace(solid, surface=np.where(chosen, np.array(numbers)[side], solid.surface))

"""Pure but for its pictures: covers of floor and table, and a room's walls with a skirting and a window, by formula."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.errors import StartError, ViewError
from schemas.job.look import Room, Surface
from schemas.scene.scene import Walls
from schemas.scene.shape import Asset, Material, Part, Shape
from schemas.scene.view import Camera
from workers.assets.look.appearance import floor_uv
from workers.assets.look.pictures import Picture, load_picture
from workers.geometry.colour import encode_srgb
from workers.geometry.mesh import face_planes


@dataclass(frozen=True, eq=False)
class Coat:
    """What a floor or table is covered with: its material, size of a tile [2] (metres, width and height), and its name."""

    material: Material
    tile_m: Array
    name: str
    rng: np.random.Generator


def draw_coat(surface: Surface, pictures: Sequence[Picture], rng: np.random.Generator, roughness: float) -> Coat:
    """One of the surface's pictures or colours, each as likely as the next."""
    if surface.colours:
        colour = surface.colours[int(rng.integers(len(surface.colours)))]
        name = "[" + ", ".join(f"{c:g}" for c in colour) + "]"
        return Coat(Material((*colour, 1.0), roughness=roughness), np.ones(2), name, rng)
    picture = pictures[int(rng.integers(len(pictures)))]
    texture = load_picture(picture)
    width_m = rng.uniform(*surface.tile_m)
    size = np.array([width_m, width_m * texture.shape[0] / texture.shape[1]])
    return Coat(Material((1.0, 1.0, 1.0, 1.0), roughness=roughness, texture=texture), size, picture.name, rng)


def cover_floor(floor: Shape, coat: Coat) -> Shape:
    """The level floor with another cover, at a random angle and offset."""
    (part,) = floor.parts
    return Shape((replace(part, material=coat.material, uv=floor_uv(coat.rng, coat.tile_m)),), floor.closed)


def cover_table(asset: Asset, coat: Coat) -> Shape:
    """The table's shape with another cover on all that is no metal, laid on along the axes of its box (triplanar), in metres."""
    shift = coat.rng.random(2)

    def cover(part: Part, flat: Part) -> Part:
        if part.material.metallic > 0.0:
            return part
        assert flat.uv is not None
        return replace(flat, material=coat.material, uv=frozen_array(flat.uv / coat.tile_m + shift), colors=None)

    parts = map(cover, asset.shape.parts, _unfolded(asset))
    return Shape(tuple(parts), asset.shape.closed)


_unfolds: WeakKeyDictionary[Asset, tuple[Part, ...]] = WeakKeyDictionary()


def _unfolded(asset: Asset) -> tuple[Part, ...]:
    """The parts of a shape with uv in metres, made once for each asset.

    Each face is seen along the axis that it faces most. A vertex between faces of several axes is there once for each; faces stay
    in their order, and so does every corner of them.
    """
    if asset not in _unfolds:
        _unfolds[asset] = tuple(map(_unfold, asset.shape.parts))
    return _unfolds[asset]


_ACROSS = np.array([[1, 2], [0, 2], [0, 1]])
"""The axes that run along u and v on a face, by the axis that it faces."""


def _unfold(part: Part) -> Part:
    normals, _ = face_planes(Shape((part,)).mesh)
    axis = np.abs(normals).argmax(axis=1)
    corners = part.faces.astype(np.int64) * 3 + axis[:, None]
    kept, faces = np.unique(corners, return_inverse=True)
    source, facing = np.divmod(kept, 3)
    vertices = part.vertices[source]
    return replace(
        part,
        vertices=frozen_array(vertices),
        faces=frozen_array(faces.reshape(-1, 3), np.int32),
        normals=None if part.normals is None else frozen_array(part.normals[source]),
        uv=frozen_array(np.take_along_axis(vertices, _ACROSS[facing], axis=1)),
        colors=None,
    )


THICK_M, SKIRTING_M = 0.1, 0.015
"""Thickness of a wall, and of the skirting before it."""

MARGIN_M = 0.05
"""Least distance of the table, and of a camera, from a wall."""

SHINE = 4.0
"""Light of the window, as a multiple of what a white surface in its place would send."""


def build_room(room: Room, light: Array, rng: np.random.Generator) -> Walls:
    """Four walls about the origin, on z = 0; the window is where `light` [3], the direction to the key light, meets them."""
    half, height = 0.5 * rng.uniform(*room.size_m, 2), rng.uniform(*room.height_m)
    paint = rng.uniform(0.72, 0.92) * (1.0 + rng.uniform(-0.07, 0.07, 3))
    wood = rng.uniform(0.45, 0.95) * np.array([1.0, *np.cumprod(rng.uniform(0.85, 1.0, 2))])
    low_m = rng.uniform(0.07, 0.13)
    walls, skirting = list[Box](), list[Box]()
    for side in range(4):
        out, along = half[side % 2], half[1 - side % 2]
        walls.append((side, (out, -along, 0.0), (out + THICK_M, along + THICK_M, height)))
        skirting.append((side, (out - SKIRTING_M, -along, 0.0), (out, along - SKIRTING_M, low_m)))
    panes, bars = _window(half, height, light, rng)
    parts = (
        _boxes("walls", walls, Material(_opaque(paint), roughness=0.95, texture=wall_shade())),
        _boxes("skirting", skirting, Material(_opaque(wood), roughness=0.85)),
        _boxes("window", panes, Material((1.0, 1.0, 1.0, 1.0), roughness=0.95, emission=SHINE)),
        _boxes("frame", bars, Material((0.93, 0.93, 0.92, 1.0), roughness=0.8)),
    )
    return Walls(Shape(parts, closed=True), frozen_array([*(2.0 * half), height]))


Box = tuple[int, tuple[float, float, float], tuple[float, float, float]]
"""The side of the room, 0 at +x, counter-clockwise; lower and upper corner: out of the room, along the wall, up."""


def _window(half: Array, height: float, light: Array, rng: np.random.Generator) -> tuple[list[Box], list[Box]]:
    """The pane, and the bars before it: a frame, a mullion and a transom."""
    reach = half / np.maximum(np.abs(light[:2]), 1e-9)
    axis = int(reach.argmin())
    side = axis + (2 if light[axis] < 0.0 else 0)
    turn = 1.0 if side in (0, 3) else -1.0  # along the wall is counter-clockwise
    wide, high = min(rng.uniform(1.2, 1.9), 1.6 * half[1 - axis]), min(rng.uniform(1.0, 1.4), 0.5 * height)
    sill, most = 0.35 * height, half[1 - axis] - 0.5 * wide - 2.0 * MARGIN_M
    middle = float(np.clip(turn * reach[axis] * light[1 - axis], -most, most))
    out, left, right = half[axis], middle - 0.5 * wide, middle + 0.5 * wide

    def bar(y: float, z: float, y_end: float, z_end: float) -> Box:
        return side, (out - 0.04, y, z), (out, y_end, z_end)

    b, top = 0.05, sill + high
    bars = [bar(at - b / 2, sill, at + b / 2, top) for at in (left, middle, right)]
    bars += [bar(left, at - b / 2, right, at + b / 2) for at in (sill, sill + 0.6 * high, top)]
    return [(side, (out - 0.02, left, sill), (out, right, top))], bars


def _opaque(colour: Array) -> tuple[float, float, float, float]:
    red, green, blue = (float(c) for c in np.clip(colour, 0.0, 1.0))
    return red, green, blue, 1.0


_CORNERS = np.array(list(np.ndindex(2, 2, 2)))
_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
"""The corners of each side of a box, counter-clockwise from outside."""
_QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def _boxes(name: str, boxes: Sequence[Box], material: Material) -> Part:
    """Boxes with corners of their own on each side; uv from 0 to 1 along a wall and up, on every side of a box."""
    vertices, uv = [], []
    for side, low, high in boxes:
        corners = np.where(_CORNERS, high, low)
        cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[side]
        turned = np.stack(
            [
                cosine * corners[:, 0] - sine * corners[:, 1],
                sine * corners[:, 0] + cosine * corners[:, 1],
                corners[:, 2],
            ],
            axis=1,
        )
        vertices.append(turned[_SIDES.ravel()])
        uv.append(_CORNERS[_SIDES.ravel()][:, 1:].astype(np.float64))
    faces = (4 * np.arange(6 * len(boxes))[:, None, None] + _QUAD).reshape(-1, 3)
    return Part(
        name,
        frozen_array(np.concatenate(vertices)),
        frozen_array(faces, np.int32),
        material,
        uv=frozen_array(np.concatenate(uv)),
    )


@functools.cache
def wall_shade() -> NDArray[np.uint8]:
    """[256, 512, 3] uint8: plaster, darker towards the corners and the floor, as less of the room lights it there."""
    rng = np.random.default_rng(np.random.SeedSequence(_SEED))
    across, up = (np.arange(512) + 0.5) / 512, 1.0 - (np.arange(256) + 0.5) / 256
    open_across = 1.0 - 0.3 * (np.exp(-across / 0.06) + np.exp(-(1.0 - across) / 0.06))
    open_up = 1.0 - 0.3 * np.exp(-up / 0.08)
    grain = cv2.GaussianBlur(rng.normal(0.0, 0.03, (256, 512)), (0, 0), 1.2)
    shade = np.clip(open_up[:, None] * open_across[None] + grain, 0.0, 1.0)
    return frozen_array(np.rint(255.0 * encode_srgb(shade))[..., None].repeat(3, axis=2), np.uint8)


_SEED = 60_733
"""Seed of the plaster, which is the same in every dataset."""


def require_inside(walls: Walls, name: str, vertices: Array) -> None:
    """Raises StartError where the vertices [N, 3] of a table or a board come nearer than `MARGIN_M` to a wall."""
    lacks = np.abs(vertices[:, :2]).max(axis=0) + MARGIN_M - 0.5 * walls.size_m[:2]
    if lacks.max() > 0.0:
        size = " x ".join(f"{side:.2f}" for side in walls.size_m[:2])
        raise StartError(
            "room_too_small",
            f"the {name} reaches {lacks.max():.2f} m beyond a room of {size} m: raise look.room.size_m",
        )


def require_camera_inside(walls: Walls | None, name: str, camera: Camera) -> None:
    """Raises ViewError where a camera stands nearer than `MARGIN_M` to a wall or outside, at any height."""
    if walls is None:
        return
    lacks = float((np.abs(camera.position[:2]) + MARGIN_M - 0.5 * walls.size_m[:2]).max())
    if lacks > 0.0:
        size = " x ".join(f"{side:.2f}" for side in walls.size_m[:2])
        raise ViewError(
            "camera_outside_room",
            f"the {name} camera stands {lacks:.2f} m too far out for a room of {size} m: raise look.room.size_m, or stand nearer",
        )

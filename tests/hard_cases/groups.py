"""Several objects that are let go at once: where each starts, and the tables that keep them together."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import trimesh

from schemas.base import Array, frozen_array
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import Asset
from tests.hard_cases.bodies import ball, built_in, cube
from tests.hard_cases.drops import Y, level, table_of, turn
from tests.kit.shapes import asset_of, box
from workers.geometry.frames import pose, uniform_rotation
from workers.geometry.hull import convex_hull

GAP_M = 0.0005
"""Between what is let go one above the other."""

FREE_M = 1e-4
"""Between what leans and what holds it, at release."""

TOUCH_M = 1e-5
"""The same for what balances: a fall of 0.1 mm gives what it takes to tip over an edge 1 mm from the centre of mass."""

SMALL_M = 0.05
"""Side of the cubes that are piled."""

DOMINO_M = (0.0075, 0.024, 0.048)
PITCH_M = 0.02
"""From one domino to the next, 12.5 mm of it empty."""

PLANK_M, PLANK_THICK_M = 0.25, 0.01
LEAN_DEG = 60.0
"""Of the plank from upright: it goes over the edge of a cube of 100 mm, 200 mm from its foot."""


@dataclass(frozen=True, eq=False)
class Group:
    """Objects at release, and their table."""

    starts: tuple[ObjectStart, ...]
    table: Table


def heavy(asset: Asset, mass_kg: float) -> Asset:
    """The same body of another density."""
    mass, times = asset.mass, mass_kg / asset.mass.mass_kg
    return dataclasses.replace(
        asset, mass=dataclasses.replace(mass, mass_kg=mass_kg, inertia=frozen_array(mass.inertia * times))
    )


def put(
    asset: Asset, table: Table, bottom_m: float, xy: tuple[float, float] = (0.0, 0.0), R: Array | None = None
) -> ObjectStart:
    """The object with its centre of mass over `xy` and its lowest point `bottom_m` above the table's top."""
    hull, R = convex_hull(asset.shape.vertices), np.eye(3) if R is None else R
    lowest = float((hull.vertices @ R.T)[:, 2].min())
    com = R @ asset.mass.com
    T = pose(R, np.array([xy[0] - com[0], xy[1] - com[1], table.top.height_m + bottom_m - lowest]))
    return ObjectStart(asset, hull, 3, frozen_array(T), 0, False)


def together(table: Table, starts: Sequence[ObjectStart]) -> Group:
    """The group, its regions numbered from 3 on."""
    return Group(tuple(dataclasses.replace(start, region_id=3 + k) for k, start in enumerate(starts)), table)


def stack(*assets: Asset, turned_deg: float = 0.0) -> Group:
    """One above the other from below, the next one turned by so much."""
    table, starts, bottom = level(), list[ObjectStart](), GAP_M
    for number, asset in enumerate(assets):
        R = turn(np.array([0.0, 0.0, 1.0]), number * turned_deg)
        starts.append(put(asset, table, bottom, R=R))
        bottom += float(np.ptp(asset.shape.vertices[:, 2])) + GAP_M
    return together(table, starts)


def tray(walls_m: float = 0.15, inner_m: float = 0.3) -> Table:
    """A square slab with walls."""
    at, long = inner_m / 2 + 0.01, inner_m + 0.04
    walls = [box(0.02, long, walls_m, (x, 0, walls_m / 2)) for x in (-at, at)]
    walls += [box(long, 0.02, walls_m, (0, y, walls_m / 2)) for y in (-at, at)]
    return table_of(box(long, long, 0.03, (0, 0, -0.015)), *walls)


def pile(count: int, seed: int = 20, walls_m: float = 0.15) -> Group:
    """So many boxes of three kinds, each turned any way, four in a layer, into a tray."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    kinds = [asset_of(box(*sides)) for sides in ((0.05, 0.05, 0.05), (0.03, 0.05, 0.07), (0.02, 0.06, 0.06))]
    table, starts = tray(walls_m), list[ObjectStart]()
    for number in range(count):
        layer, place = divmod(number, 4)
        xy = (0.06 * (-1) ** (place % 2), 0.06 * (-1) ** (place // 2))
        starts.append(put(kinds[number % 3], table, 0.01 + 0.1 * layer, xy, uniform_rotation(rng)))
    return together(table, starts)


def two_in_one_place() -> Group:
    """Two cubes of 100 mm, one within the other but for 1 mm."""
    table = level()
    return together(table, [put(cube(), table, GAP_M), put(cube(), table, GAP_M, (0.001, 0.0))])


def open_box() -> Asset:
    """An open box of five boards."""
    boards = [box(0.1, 0.1, 0.01, (0, 0, 0.005))]
    boards += [box(0.01, 0.1, 0.05, (x, 0, 0.035)) for x in (-0.045, 0.045)]
    boards += [box(0.08, 0.01, 0.05, (0, y, 0.035)) for y in (-0.045, 0.045)]
    return asset_of(*boards)


def in_a_tray(vessel: Asset | None = None) -> Group:
    """A cube of 30 mm in an open box, which weighs as much."""
    table = level()
    return together(table, [put(vessel or open_box(), table, GAP_M), put(cube(0.03), table, 0.02, (0.01, 0.005))])


def in_a_bowl() -> Group:
    """A ball of 20 mm let go over the middle of a bowl."""
    table, bowl = level(), built_in("bowl")
    above = float(np.ptp(bowl.shape.vertices[:, 2])) + 0.001
    return together(table, [put(bowl, table, GAP_M), put(ball(0.01, 3), table, above)])


def leaning(block: Asset | None = None, plank: Asset | None = None) -> Group:
    """A plank on the edge of a heavy cube: its foot on the table, `LEAN_DEG` from upright, both 0.1 mm away."""
    table, up = level(), math.radians(90.0 - LEAN_DEG)
    plank = plank or asset_of(box(PLANK_M, 0.05, PLANK_THICK_M), mass_kg=0.2)
    along, across = np.array([math.cos(up), math.sin(up)]), np.array([-math.sin(up), math.cos(up)])
    edge = np.array([-0.05, 0.1])  # of the cube, whose middle is over the origin
    foot = edge - 0.2 * along
    centre = foot + (0.1001 - 0.1) * across + PLANK_M / 2 * along + PLANK_THICK_M / 2 * across
    start = put(plank, table, 0.0001, (float(centre[0]), 0.0), turn(Y, -math.degrees(up)))
    return together(table, [put(block or heavy(cube(), 3.0), table, 0.0001), start])


def dominoes(count: int, pushed_deg: float, domino: Asset | None = None) -> Group:
    """A row along x, the first of which leans towards the next by so much."""
    table, domino = level(), domino or asset_of(box(*DOMINO_M), mass_kg=0.015)
    starts = [put(domino, table, 0.0002, (PITCH_M * (number - count / 2), 0.0)) for number in range(count)]
    starts[0] = put(domino, table, 0.0002, (-PITCH_M * count / 2, 0.0), turn(Y, pushed_deg))
    return together(table, starts)


def lintel() -> Group:
    """A board on two cubes."""
    table, board = level(), asset_of(box(0.3, 0.06, 0.01))
    posts = [put(cube(SMALL_M), table, GAP_M, (x, 0.0)) for x in (-0.1, 0.1)]
    return together(table, [*posts, put(board, table, SMALL_M + 2 * GAP_M)])


def onto_another() -> Group:
    """A cube of 50 mm that falls from 300 mm onto the middle of one of 100 mm."""
    table = level()
    return together(table, [put(cube(), table, GAP_M), put(cube(SMALL_M), table, 0.4, (0.005, 0.0))])


def prism(outline: Sequence[tuple[float, float]], width_m: float, mass_kg: float = 0.5) -> Asset:
    """A solid of this outline in x and z, so wide along y."""
    solid: Any = trimesh.creation.extrude_polygon(shapely.Polygon(outline), width_m)
    upright = np.array(
        [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, width_m / 2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    solid.apply_transform(upright)
    return asset_of(solid, mass_kg=mass_kg)


def place(
    asset: Asset, table: Table, offset: Sequence[float] | Array = (0.0, 0.0, 0.0), R: Array | None = None
) -> ObjectStart:
    """The object with its own frame's origin there, z from the table's top."""
    T = pose(np.eye(3) if R is None else R, np.add(offset, [0.0, 0.0, table.top.height_m]))
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, frozen_array(T), 0, False)

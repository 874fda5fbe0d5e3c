"""Rows of the table of hard cases: what lies in, on or through the hollow of another; some of it from files."""

import functools
import math
from typing import Any

import manifold3d
import numpy as np
import trimesh

from schemas.base import Array
from schemas.scene.shape import Asset
from tests.hard_cases import outside
from tests.hard_cases.bodies import ball, built_in
from tests.hard_cases.case import EITHER, UNDEFINED, Case, settles
from tests.hard_cases.drops import Drop, X, level, table_of, turn
from tests.hard_cases.groups import FREE_M, Group, heavy, in_a_bowl, in_a_tray, open_box, place, put, together
from tests.hard_cases.measures import (
    Made,
    Measure,
    Rest,
    apart,
    beside,
    both,
    flat,
    height,
    heights,
    shift,
    tilt,
    tilts,
)
from tests.kit.shapes import asset_of, box
from workers.geometry.frames import transform


@functools.cache
def bowl_from_file() -> Asset:
    """The built-in bowl, written to a file and read through the door: nothing tells its convex parts but its mesh."""
    return outside.enter(outside.of(built_in("bowl").shape.mesh))


@functools.cache
def mug_from_file() -> Asset:
    """The built-in mug through the door."""
    return outside.enter(outside.of(built_in("mug").shape.mesh))


def solid(vertices: Array, faces: Any) -> Any:
    """The body that a closed mesh encloses; equal points are one."""
    whole = trimesh.Trimesh(vertices, faces, process=False)
    whole.merge_vertices(digits_vertex=9)
    points = np.ascontiguousarray(whole.vertices, np.float64)
    return manifold3d.Manifold(manifold3d.Mesh64(points, np.ascontiguousarray(whole.faces, np.uint64)))


@functools.cache
def nesting_m(category: str) -> float:
    """How much higher one of two like vessels stands in the other, upright and the same way round.

    By bisection between overlap and none, from the volume of the intersection.
    """
    mesh = built_in(category).shape.mesh
    low, high = 0.0, float(np.ptp(mesh.vertices[:, 2]))
    lower = solid(mesh.vertices, mesh.faces)
    while high - low > 1e-7:
        middle = (low + high) / 2
        upper = solid(np.add(mesh.vertices, [0.0, 0.0, middle]), mesh.faces)
        low, high = (middle, high) if (lower ^ upper).volume() > 0.0 else (low, middle)
    return high


def nested(asset: Asset, count: int) -> Group:
    """Bowls in one another, 1 mm apart."""
    table = level()
    return together(table, [put(asset, table, FREE_M + k * (nesting_m("bowl") + 0.001)) for k in range(count)])


def nested_up(count: int) -> Measure:
    """Each bowl upright, at its height in the one below."""
    low = built_in("bowl").mass.com[2] - built_in("bowl").shape.vertices[:, 2].min()
    return both(
        heights(*(low + k * nesting_m("bowl") for k in range(count)), bound_mm=0.1 * count),
        tilts(*[0.0] * count, bound_deg=1.0),
    )


CUP_M, WALL_M, HIGH_M = (0.02, 0.03), 0.002, 0.08
"""Radii below and above, wall and height of a tapered cup."""


def cups(count: int) -> Group:
    """Tapered cups of 48 sides over one another, each with its foot in the one below, a fall of 2 mm from where it fits."""
    (low, high), table = CUP_M, level()
    outline = [[0, 0], [low, 0], [high, HIGH_M], [high - WALL_M, HIGH_M], [low - WALL_M, WALL_M], [0, WALL_M]]
    cup = asset_of(trimesh.creation.revolve(np.array(outline), sections=48), mass_kg=0.03)
    return together(table, [put(cup, table, 0.001 + 0.02 * k) for k in range(count)])


def fitting_m() -> float:
    """How far above a cup's foot its wall is as wide as the foot of the next: w + w (h - w) / (R - r)."""
    return WALL_M + WALL_M * (HIGH_M - WALL_M) / (CUP_M[1] - CUP_M[0])


@functools.cache
def plate() -> Asset:
    """A plate 200 mm across with a rim that rises at 20 in 51, and a foot 1 mm wider than its inner floor."""
    outline = [[0, 0], [0.05, 0], [0.1, 0.02], [0.1, 0.024], [0.049, 0.004], [0, 0.004]]
    return asset_of(trimesh.creation.revolve(np.array(outline), sections=48), mass_kg=0.3)


PLATES_M = 0.004 + 0.001 * 20 / 51
"""How far above a plate's foot the next one's stands, on the rim."""


def plates(count: int) -> Group:
    """Plates, each a millimetre above where it stands on the one below."""
    table = level()
    return together(table, [put(plate(), table, 0.001 + k * (PLATES_M + 0.001)) for k in range(count)])


def lifted(step_m: float, bound_mm: float = 0.01) -> Measure:
    """How far the lowest corner of each is from a step above that of the one before."""

    def off(made: Made, rest: Rest) -> float:
        pairs = zip(made.starts, rest, strict=True)
        low = [transform(one.T_world_obj, start.hull.vertices)[:, 2].min() for start, one in pairs]
        return float(np.abs(np.diff(low) - step_m).max()) * 1e3

    return Measure("worst step off what it must be, mm", bound_mm, off)


def boxes_in_boxes() -> Group:
    """Three open boxes in one another, 5 mm of air about each."""
    table, starts = level(), []
    for k in range(3):
        side_m = 0.1 - 0.02 * k
        hollow = box(side_m - 0.006, side_m - 0.006, 0.05, (0, 0, 0.003))
        shell = asset_of(box(side_m, side_m, 0.05).difference(hollow), mass_kg=0.1)
        starts.append(put(shell, table, 0.0005 + 0.004 * k))
    return together(table, starts)


SEAT_M = (0.08, 0.08, 0.006)
"""Width, depth and thickness of a chair's seat, which is 50 mm above its feet."""


def chair() -> Asset:
    """A chair that stacks: its legs and its back lean outwards by 1 in 2, and are half a millimetre less than 3 mm thick.

    Raised by the seat's thickness, 6 mm, each is 3 mm beside the one below: seat lies on seat.
    """
    (wide, deep, thick), high, lean = SEAT_M, 0.05, 0.5
    x, y = wide / 2, deep / 2
    parts = [[(i * x, j * y, high - k * thick) for i in (-1, 1) for j in (-1, 1) for k in (0, 1)]]
    parts += [
        [
            (side * (x + lean * (high - z) - w), v, z)
            for z in (0.0, high)
            for w in (0.0, 0.0025)
            for v in (end, end * 0.85)
        ]
        for side in (-1, 1)
        for end in (-y, y)
    ]
    behind = ((y + lean * (z - high + thick) + w, z) for z in (high - thick, 0.1) for w in (-1e-4, 0.0024))
    parts.append([(u, v, z) for v, z in behind for u in (-x, x)])
    whole = manifold3d.Manifold.batch_boolean(
        [manifold3d.Manifold.hull_points(np.array(part)) for part in parts], manifold3d.OpType.Add
    ).to_mesh64()
    return asset_of(trimesh.Trimesh(np.asarray(whole.vert_properties)[:, :3], np.asarray(whole.tri_verts)), mass_kg=0.1)


def chairs(count: int) -> Group:
    """Chairs, each a millimetre above where it lies on the one below."""
    table, asset = level(), chair()
    return together(table, [put(asset, table, 0.001 + k * (SEAT_M[2] + 0.001)) for k in range(count)])


def lowest_within(bound_mm: float, body: int = 1, other: int = 0) -> Measure:
    """Sideways from the middle of one object's frame to the lowest point of another."""

    def off(made: Made, rest: Rest) -> float:
        points = transform(rest[body].T_world_obj, made.starts[body].asset.shape.vertices)
        return float(np.linalg.norm((points[np.argmin(points[:, 2])] - rest[other].T_world_obj[:3, 3])[:2])) * 1e3

    return Measure("lowest point from the vessel's middle, mm", bound_mm, off)


def dropped_in(vessel: Asset, thing: Asset, bottom_m: float, x_m: float = 0.0, R: Array | None = None) -> Group:
    """A thing let go over a vessel or in it, its lowest point so high over the table."""
    table = level()
    return together(table, [put(vessel, table, FREE_M), put(thing, table, bottom_m, (x_m, 0.0), R)])


BALL_M = 0.01

RIM_INSIDE_M, RIM_OUTSIDE_M = 0.0725, 0.0778
"""Radii of the bowl's rim."""


def floor_m(category: str) -> float:
    """Height of the middle of a vessel's inner floor over what it stands on."""
    points = built_in(category).shape.vertices
    middle = points[np.hypot(points[:, 0], points[:, 1]) < 1e-6]
    return float(middle[:, 2].max() - points[:, 2].min())


def at_the_bottom() -> Measure:
    """A ball of 10 mm in the middle of a bowl: within 2 mm of the lowest that it can be, and 15 mm of the axis.

    The floor rises to 12 mm at a radius of 11.5 by 2.5 degrees. Friction against rolling holds a ball of 10 mm up to
    0.7 / 10, 4 degrees, that is on the two inner rings of faces, within 21 mm.
    """
    return both(height(floor_m("bowl") + BALL_M, 2.0, body=1), beside(21.0))


# ---------------------------------------------------------------------------------------------- mugs, spoons, rings


def linked_mugs() -> Group:
    """Two mugs whose handles go through one another: one upright, the other on its side, its handle level.

    Each opening goes from 23 to 47 mm in x and 50 in z about 8, and each bar from 49 to 55: 88 mm apart, each bar is in the
    middle of the other's opening. They can part by no more than the slack, some 9 mm.
    """
    table, mug = level(), built_in("mug")
    lying = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    side_m = float(-mug.shape.vertices[:, 1].min())
    other = place(mug, table, (0.088, -0.008, side_m + FREE_M), lying)
    foot_m = float(-mug.shape.vertices[:, 2].min())
    return together(table, [place(mug, table, (0.0, 0.0, foot_m + FREE_M)), other])


def spoon() -> Asset:
    """A rod of 6 mm with a flat blade at its end, 130 mm long, through the door."""
    rod = trimesh.creation.cylinder(0.003, 0.11, sections=24)
    blade = trimesh.creation.icosphere(subdivisions=3)
    blade.apply_scale([0.014, 0.004, 0.02])
    blade.apply_translation((0, 0, -0.065))
    whole = solid(rod.vertices, rod.faces) + solid(blade.vertices, blade.faces)
    mesh = whole.to_mesh64()
    return outside.enter(outside.obj(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts)))


RING_M = (0.015, 0.022, 0.01)
"""Inner and outer radius and height of a ring."""


def ring() -> Asset:
    """The ring, its axis along z."""
    return asset_of(trimesh.creation.annulus(r_min=RING_M[0], r_max=RING_M[1], height=RING_M[2], sections=96))


def ring_over_peg() -> Drop:
    """The ring let go over the top of a peg 40 mm high that stands on the table and is 24 mm across."""
    peg = trimesh.creation.cylinder(0.012, 0.04, sections=48)
    peg.apply_translation((0, 0, 0.72))
    table = table_of(box(1.4, 1.4, 0.03, (0, 0, 0.685)), peg)
    return Drop(put(ring(), table, 0.045), table)


def ball_on_ring_m() -> float:
    """Height of a ball of 20 mm on a ring on a table, the triangle over the ring's inner radius."""
    return RING_M[2] + math.sqrt(0.02**2 - RING_M[0] ** 2)


SPOONS = both(tilt(0.5), lowest_within(45.0))
"""In an upright mug, whose axis is 12 mm from the middle of its box, and whose inner radius is at most 41 mm at the rim."""

HOLLOWS = (
    settles("cube in an open box", heights(6.8 / 280, 0.025, bound_mm=0.02), in_a_tray),
    settles(
        "cube in an open box from a file",
        heights(6.8 / 280, 0.025, bound_mm=0.02),
        lambda: in_a_tray(outside.enter(outside.of(open_box().shape.mesh))),
    ),
    settles("ball in a bowl", at_the_bottom(), in_a_bowl, tier="minute", again="slow"),
    settles(
        "ball in a bowl from a file",
        at_the_bottom(),
        lambda: dropped_in(bowl_from_file(), ball(BALL_M, 3), 0.03),
        tier="minute",
        again="slow",
    ),
    settles("two bowls in one another", nested_up(2), lambda: nested(built_in("bowl"), 2), tier="minute", again="slow"),
    settles("five bowls in one another", nested_up(5), lambda: nested(built_in("bowl"), 5), tier="slow"),
    settles(
        "two bowls from a file in one another",
        nested_up(2),
        lambda: nested(bowl_from_file(), 2),
        tier="minute",
        again="slow",
    ),
    settles("two tapered cups in one another", lifted(fitting_m(), 0.2), lambda: cups(2), tier="minute"),
    settles(
        "three tapered cups in one another",
        both(lifted(fitting_m(), 0.2), tilts(0, 0, 0, bound_deg=1.0)),
        lambda: cups(3),
        tier="minute",
        again="slow",
    ),
    # Let go on 821 faces, which may use up what letting go may cost; then it is refused by name. Twenty nudged seeds settle.
    Case(
        "five tapered cups in one another",
        UNDEFINED,
        both(lifted(fitting_m(), 0.4), tilts(0, 0, 0, 0, 0, bound_deg=1.0)),
        lambda: cups(5),
        tier="minute",
        again="slow",
    ),
    settles(
        "six plates on one another",
        both(lifted(PLATES_M, 0.3), tilts(*[0] * 6, bound_deg=2.0)),
        lambda: plates(6),
        tier="minute",
        again="slow",
    ),
    settles("three open boxes in one another", both(lifted(0.003), tilts(0, 0, 0, bound_deg=0.1)), boxes_in_boxes),
    settles(
        "three chairs on one another", both(lifted(SEAT_M[2], 0.02), tilts(0, 0, 0, bound_deg=0.1)), lambda: chairs(3)
    ),
    settles("two mugs linked by their handles", both(tilt(0.5), apart(15.0)), linked_mugs, tier="minute", again="slow"),
    settles(
        "spoon in a mug from a file",
        SPOONS,
        lambda: dropped_in(mug_from_file(), spoon(), 0.012, -0.012, turn(X, 12.0)),
        tier="minute",
        again="slow",
    ),
    settles(
        "stick in a mug",
        SPOONS,
        lambda: dropped_in(
            built_in("mug"), asset_of(box(0.006, 0.006, 0.16), mass_kg=0.005), 0.012, -0.012, turn(X, 12.0)
        ),
        tier="minute",
        again="slow",
    ),
    # It falls through 10 mm and lies on the table around the peg, which it can be off by no more than the slack.
    settles(
        "ring over a peg",
        both(flat(0.1), height(RING_M[2] / 2, 0.01), shift(3.1)),
        ring_over_peg,
        tier="minute",
        again="slow",
    ),
    # Steeper than friction holds at 41 degrees; the three or more points around it hold it all the same.
    settles(
        "ball on a ring",
        heights(RING_M[2] / 2, ball_on_ring_m(), bound_mm=0.1),
        lambda: dropped_in(ring(), heavy(ball(0.02), 0.05), 0.004),
        tier="minute",
        again="slow",
    ),
    settles(
        "marble 3 mm inside of a bowl's rim",
        at_the_bottom(),
        lambda: dropped_in(built_in("bowl"), heavy(ball(BALL_M, 3), 0.005), 0.079, RIM_INSIDE_M - 0.003),
        tier="minute",
        again="slow",
    ),
    # It rolls down from 79 mm with up to 1 m/s, and 0.6 m of table may not stop it.
    Case(
        "marble 3 mm outside of a bowl's rim",
        EITHER,
        height(BALL_M, 0.05, body=1),
        lambda: dropped_in(built_in("bowl"), heavy(ball(BALL_M, 3), 0.005), 0.079, RIM_OUTSIDE_M + 0.003),
        tier="minute",
        again="slow",
    ),
)

"""The objects of the hard cases, z up in their own frame."""

import dataclasses
import functools
import math

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from schemas.job.assets import ProceduralSource
from schemas.scene.shape import Asset
from tests.hard_cases.drops import EDGE_M, Drop, X, drop, level, turn, with_peg
from tests.kit.shapes import asset_of, box
from tests.workers.door.oracles import hits
from workers.assets.builtin.make import make_asset


def cube(side_m: float = 0.1) -> Asset:
    """A box of equal sides."""
    return asset_of(box(side_m, side_m, side_m))


def rod(radius_m: float, length_m: float, sections: int = 48) -> Asset:
    """A prism of many sides: coin, needle, can, bottle."""
    return asset_of(trimesh.creation.cylinder(radius_m, length_m, sections=sections))


def ball(radius_m: float, subdivisions: int = 4) -> Asset:
    """An icosphere."""
    return asset_of(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m))


def globe(radius_m: float) -> Asset:
    """A ball about z of 360 meridians, with an even band at its equator: it stands on no slope over half a degree."""
    meridian, parallel = np.meshgrid(np.arange(360) * np.pi / 180, (np.arange(16) + 0.5) * np.pi / 16, indexing="ij")
    level, up = np.sin(parallel), np.cos(parallel)
    points = radius_m * np.stack([level * np.cos(meridian), level * np.sin(meridian), up], axis=-1)
    return asset_of(trimesh.convex.convex_hull(points.reshape(-1, 3)))


@functools.cache
def built_in(category: str, index: int = 0) -> Asset:
    """A built-in shape in its true size."""
    return make_asset(category, ProceduralSource(source="procedural", size="metric"), index, 600.0)


def over_edge(share: float) -> Drop:
    """A 100 mm cube with this share of its length beyond the table's edge, 5 mm above the top."""
    return drop(cube(), level(), xy=(EDGE_M + (share - 0.5) * 0.1, 0.0))


# ---------------------------------------------------------------------------------------------- laptop


def laptop_angles() -> tuple[float, float]:
    """Degrees to lean an open laptop back until it tips, and between its up and the world's when it lies again.

    From the hull's outline in the plane across the hinge. It tips where one of its corners is lowest and right below the
    centre of mass; it lies on the next side of the outline that has the centre of mass over it.
    """
    asset = built_in("laptop")
    points = asset.shape.vertices[:, 1:] - asset.mass.com[1:]
    hull = ConvexHull(points)
    tips = []
    for y, z in points[hull.vertices]:
        angle = math.atan2(y, -z)
        lowest = (-points[:, 0] * math.sin(angle) + points[:, 1] * math.cos(angle)).min()
        if angle > 0.0 and math.isclose(lowest, -math.hypot(y, z), abs_tol=1e-9):
            tips.append(math.degrees(angle))
    lies = []
    for (a, b), (ny, nz, _) in zip(hull.simplices, hull.equations, strict=True):
        along = (points[b] - points[a]) / np.linalg.norm(points[b] - points[a])
        angle = math.degrees(math.atan2(ny, -nz)) % 360.0
        if (points[a] @ along) * (points[b] @ along) < 0.0 and angle > min(tips):
            lies.append(angle)
    return min(tips), min(min(lies), 360.0 - min(lies))


def laptop_leaning(beyond_deg: float) -> Drop:
    """An open laptop on its rear lower edge, this far beyond the angle at which it tips over backwards."""
    return drop(built_in("laptop"), level(), 0.0002, turn(X, -(laptop_angles()[0] + beyond_deg)))


# ---------------------------------------------------------------------------------------------- mug and handle


def handle_reach() -> tuple[float, float]:
    """(x of the inner side of the mug's handle, z of its middle), metres, in the mug's frame."""
    mesh = built_in("mug").shape.mesh
    z = float(mesh.vertices[np.argmax(mesh.vertices[:, 0]), 2])
    distances, _ = hits(mesh.vertices, mesh.faces, np.array([1.0, 1e-5, z]), np.array([-1.0, 0.0, 0.0]))
    return 1.0 - float(distances[1]), z


def mug_on_peg() -> Drop:
    """A mug hung up by its handle: the peg goes through the handle, whose inner side is 1 mm above it."""
    table, (x, z) = with_peg(), handle_reach()
    R = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # handle up, the finger's way along the peg
    return _at(drop(built_in("mug"), table, R=R), (0.72, -z, table.top.height_m - x + 0.001))


def mug_handle_over_edge() -> Drop:
    """An upright mug beside the table, the bar of its handle 1 mm above the top: nothing holds its body up."""
    table, (x, _), asset = level(), handle_reach(), built_in("mug")
    over = asset.shape.vertices[asset.shape.vertices[:, 0] > x - 0.002]
    beside = drop(asset, table, R=turn(np.array([0.0, 0.0, 1.0]), 180.0))
    return _at(beside, (EDGE_M + x - 0.002, 0.0, table.top.height_m + 0.001 - float(over[:, 2].min())))


def _at(case: Drop, position: tuple[float, float, float]) -> Drop:
    T = np.array(case.start.T_world_obj)
    T[:3, 3] = position
    return Drop(dataclasses.replace(case.start, T_world_obj=T), case.table)

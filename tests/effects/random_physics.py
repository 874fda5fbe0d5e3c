"""Random scenes for the plan of effects of physics, and what they need, found in another way than the plan finds it."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
import trimesh

from schemas.base import Pose
from schemas.job.assets import CATEGORIES
from schemas.scene.scene import ObjectStart, Settled, Table
from tests.effects.physics_cases import on_a_bumpy_table
from tests.effects.scenes import Setting
from workers.geometry.frames import transform
from workers.scene.effects import Facts

TOUCH_M = 1e-4
"""More than this above the table, an object falls."""

ROUNDING_M = 1e-7
"""Of a distance to a plane."""

LIPS = 0.01
"""Where the centre of mass rises by no more than this share of its height from one face to the next, an object rolls."""


def random_physics(number: int) -> Setting:
    """One to four objects near the middle or the edge, in every pose, side by side or above one another."""
    rng = np.random.default_rng((9, number))
    count = int(rng.choice([1, 1, 2, 4]))
    reach = float(rng.choice([0.05, 0.3, 0.6]))
    changes: dict[str, Any] = {
        "categories": [str(name) for name in rng.choice(CATEGORIES, 2, replace=False)],
        "objects_per_scene": count,
        "start": {
            "pose": str(rng.choice(["upright", "tumbled", "placed"])),
            "offset_m": [-reach, reach],
            "arrange": "pile" if count > 1 and rng.random() < 0.3 else "spread",
        },
    }
    if changes["start"]["arrange"] == "pile" and changes["start"]["pose"] == "placed":
        changes["start"]["pose"] = "upright"
    return Setting(changes, on_a_bumpy_table if rng.random() < 0.15 else lambda plan: plan, number)


def footprint(start: ObjectStart, *poses: Pose) -> shapely.Geometry:
    """The ground under an object at these poses, and between them."""
    points = [transform(T, start.asset.shape.vertices)[:, :2] for T in poses]
    return shapely.MultiPoint(np.concatenate(points)).convex_hull


def level_top(table: Table) -> shapely.Geometry:
    """The ground under the faces of a table that are at its top's height."""
    corners = table.mesh.vertices[table.mesh.faces]
    at_top = (np.abs(corners[:, :, 2] - table.top.height_m) < TOUCH_M).all(axis=1)
    return shapely.union_all(shapely.polygons(corners[at_top][:, :, :2]), grid_size=1e-7)


def is_hollow(start: ObjectStart) -> bool:
    """By trimesh: whether an object fills less than its hull."""
    mesh = trimesh.Trimesh(start.asset.shape.vertices, start.asset.shape.faces)
    return not mesh.is_watertight or mesh.volume < 0.999 * mesh.convex_hull.volume


def rolls(start: ObjectStart) -> bool:
    """Whether from a face that it stands on it comes to another, less than 27 degrees on, almost without climbing.

    It stands on a face where the foot of its centre of mass lies in it, which is where that foot is in no plane's outside.
    """
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(start.asset.shape.vertices)
    com, normals, corners = start.asset.mass.com, hull.face_normals, hull.triangles[:, 0]
    heights = np.einsum("ij,ij->i", corners - com, normals)
    feet = com + heights[:, None] * normals
    outside = feet @ normals.T - np.einsum("ij,ij->i", corners, normals)
    stands = outside.max(axis=1) < ROUNDING_M
    edges = hull.vertices[hull.face_adjacency_edges]
    for (a, b), turn, (p, q) in zip(hull.face_adjacency, hull.face_adjacency_angles, edges, strict=True):
        over_edge = float(np.linalg.norm(np.cross(p - com, q - p)) / np.linalg.norm(q - p))
        near = math.radians(1.5) < turn < math.radians(27.0)
        if near and stands[a] and stands[b] and over_edge <= (1.0 + LIPS) * min(heights[a], heights[b]):
            return True
    return False


def needed(facts: Facts, settled: Sequence[Settled] | None) -> set[str]:
    """What the scene needs by where things begin and, where they were settled, come to rest."""
    objects, table = facts.plan.objects, facts.plan.table
    ends: Sequence[Pose] = [s.T_world_obj for s in objects] if settled is None else [r.T_world_obj for r in settled]
    swept = [footprint(start, start.T_world_obj, T) for start, T in zip(objects, ends, strict=True)]
    lowest = [transform(s.T_world_obj, s.asset.shape.vertices)[:, 2].min() - table.top.height_m for s in objects]
    falls = any(height > TOUCH_M for height in lowest)
    meet = any(a.intersects(b) for a, b in itertools.combinations(swept, 2))
    leaves = not all(level_top(table).buffer(1e-6).contains(ground) for ground in swept)
    wanted: Mapping[str, bool] = {
        "dynamics": falls,
        "fine_step": falls,
        "table_mesh": falls and leaves,
        "object_contacts": falls and meet,
        "decomposition": falls and (leaves or meet) and any(is_hollow(start) for start in objects),
        "rolling_friction": falls and any(rolls(start) for start in objects),
    }
    return {name for name, wants in wanted.items() if wants}

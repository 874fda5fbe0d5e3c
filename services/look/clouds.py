"""Point clouds of a pair, the posed mesh and samples of shapes, packed for the page's 3-D view; world frame, metres, z up."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.errors import VersoError
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE, is_object
from services.dataset.dataset import Dataset
from services.dataset.view import View
from services.look.pictures import SHOWN_ROLES
from services.read.scene_geometry import posed_scene
from workers.geometry.camera import spread_evenly
from workers.store.store import Store

MOST_POINTS = 90_000
"""Points of one cloud; of more, the floor is thinned first and objects last."""

MOST_SPACES, FEWER_POINTS = 8, 24_000
"""Scenes that may be chosen in the 3-D view, and the points of a cloud where there are several."""

REACH_M = 1.4
"""Points of the floor beyond this horizontal distance from the objects are left out."""

QUANTUM_M = 2e-4
"""Points are packed as whole multiples of this, relative to the target: they reach 6.5 m."""

MOST_CAMERAS = 200
"""Named cameras of a scene that are drawn."""

MOST_FACES = 120_000
"""A mesh with more is drawn with its corners moved to a grid."""

NEAR_M, FARTHER = 0.95, 2.6
"""Distance, metres, from which a scene is seen first, or so many times the longest side of an object, where that is more."""

GRID_STEPS = 160
"""Cells of that grid along the longest side of the mesh."""


@dataclass(frozen=True)
class Cloud:
    """The points of one view."""

    role: str
    points: Array
    """[N, 3] metres, world."""
    colors: NDArray[np.uint8]
    """[N, 3] sRGB."""
    size_m: float
    """Distance between neighbouring points of an object that faces the camera."""
    T_world_cam: Array


@dataclass(frozen=True)
class Body:
    """A mesh of the scene."""

    kind: str
    """`object`, or `table` for what stands around it."""
    vertices: Array
    """[V, 3] metres, world."""
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class Space:
    """What the 3-D view shows of one scene."""

    scene_id: int
    category: str
    target: Array
    """[3] the middle of the objects' points, metres, world."""
    clouds: tuple[Cloud, ...]
    bodies: tuple[Body, ...]
    missing: str
    """A sentence that says why there is no mesh; empty where there is one."""
    cameras: Sequence[Pose] = ()
    """`T_world_cam` [4, 4] of those that the job names."""

    @property
    def size_m(self) -> float:
        """The longest side of the box about the objects' meshes, metres; 0 without one."""
        objects = [body.vertices for body in self.bodies if body.kind == "object"]
        return float(np.ptp(np.concatenate(objects), axis=0).max()) if objects else 0.0


def read_spaces(store: Store, scene_ids: Sequence[int]) -> tuple[Space, ...]:
    """At most `MOST_SPACES` of these scenes, evenly. Raises CorruptError for damaged images."""
    chosen = [scene_ids[place] for place in spread_evenly(len(scene_ids), MOST_SPACES)]
    most = MOST_POINTS if len(chosen) == 1 else FEWER_POINTS
    return tuple(filter(None, (read_space(store, scene_id, most) for scene_id in chosen)))


def read_space(store: Store, scene_id: int, most_points: int = MOST_POINTS) -> Space | None:
    """Clouds and mesh of a scene's first pair; None where it was not made. Raises CorruptError for damaged images."""
    for pair in Dataset(store).scene(scene_id):
        target = np.mean([pose[:3, 3] for region, pose in pair.T_world.items() if region > REGION_TABLE], axis=0)
        views = (pair.views[role] for role in SHOWN_ROLES if role in pair.views)
        clouds = tuple(cloud_of(view, target, most_points) for view in views)
        named = [view.T_world_cam for view in pair.views.values() if view.number is not None]
        cameras = [named[place] for place in spread_evenly(len(named), MOST_CAMERAS)]
        return Space(scene_id, pair.category, target, clouds, *_read_bodies(store, scene_id), cameras)
    return None


def cloud_of(view: View, target: Array, most_points: int) -> Cloud:
    """The cloud of one view's depth, in its colours; grey without RGB."""
    seen = view.cloud("world", None)
    at = tuple(seen.pixels.T)
    region, z = view.segment()[at], view.depth()[at] / view.depth_units_per_m
    near = np.hypot(*(seen.points[:, :2] - target[:2]).T) < REACH_M
    kept = np.zeros(0, np.int64)
    for group in (region >= REGION_FIRST_OBJECT, region == REGION_TABLE, region == REGION_FLOOR):
        kept = np.append(kept, _evenly(np.flatnonzero(near & group), most_points - len(kept)))
    colors = np.full((len(kept), 3), 150, np.uint8) if seen.colours is None else seen.colours[kept]
    ours = z[is_object(region)]
    size_m = float(np.median(ours if ours.size else z)) / view.camera.intrinsics.fx if z.size else 0.01
    return Cloud(view.role, seen.points[kept], colors, size_m, view.T_world_cam)


def _evenly(indices: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    return indices[:: -(-len(indices) // most)] if 0 < most < len(indices) else indices[:most]


def _read_bodies(store: Store, scene_id: int) -> tuple[tuple[Body, ...], str]:
    """(the meshes of a scene but for floor and walls, a sentence why there are none)."""
    try:
        scene = posed_scene(store, scene_id)
    except VersoError as error:
        return (), f" There is no mesh: {error}."
    bodies = []
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        mesh = scene.geometry[name]
        if node.startswith(("floor/", "walls/")) or not len(mesh.faces):
            continue
        kind = "table" if node.startswith(("table ", "board ", "clutter ")) else "object"
        vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
        bodies.append(coarsen(Body(kind, vertices, np.asarray(mesh.faces, np.int64))))
    return tuple(bodies), ""


def coarsen(body: Body) -> Body:
    """The mesh itself, or, where it has more than `MOST_FACES`, its corners moved to a grid and what collapsed left out."""
    if len(body.faces) <= MOST_FACES:
        return body
    cell_m = float(np.ptp(body.vertices, axis=0).max()) / GRID_STEPS
    mesh = trimesh.Trimesh(np.round(body.vertices / cell_m) * cell_m, body.faces)  # which merges equal corners
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return Body(body.kind, np.asarray(mesh.vertices), np.asarray(mesh.faces))


def pack_spaces(spaces: Sequence[Space]) -> str:
    """JSON for the page; arrays are base64 of little-endian numbers, points relative to the target."""
    return json.dumps(list(map(_packed, spaces)), separators=(",", ":"))


def _packed(space: Space) -> dict[str, Any]:
    clouds = [
        {
            "role": cloud.role,
            "points": _base64(np.clip(np.round((cloud.points - space.target) / QUANTUM_M), -32767, 32767), "<i2"),
            "colors": _base64(cloud.colors, "u1"),
            "size": round(cloud.size_m, 6),
            "camera": _rounded(cloud.T_world_cam),
        }
        for cloud in space.clouds
    ]
    bodies = [
        {
            "kind": body.kind,
            "vertices": _base64(body.vertices - space.target, "<f4"),
            "faces": _base64(body.faces, "<u4"),
        }
        for body in space.bodies
    ]
    return {
        "scene": space.scene_id,
        "quantum": QUANTUM_M,
        "target": _rounded(space.target),
        "far": max(NEAR_M, FARTHER * space.size_m),
        "cameras": list(map(_rounded, space.cameras)),
        "clouds": clouds,
        "bodies": bodies,
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(x), 6) for x in values.ravel()]


def _base64(values: NDArray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")

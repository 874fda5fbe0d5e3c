"""What may be said of the other side without training: the benchmark's baselines that need one pair alone; and how it is written.

Each takes a pair and gives a `Prediction` of its mirror view from its input view; docs/benchmark.md compares them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import mirror_depth
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.dataset.codec import read_matrix
from schemas.scene.shape import REGION_FIRST_OBJECT
from services.dataset.pair import Pair
from services.dataset.view import View
from workers.geometry.projection import forward_project
from workers.store.images import encode_png

ANGLES, SHIFTS = 24, 24
"""Directions and places of the upright planes that are tried."""

TRIED_POINTS: Final = 256
"""Of an object's seen points, those that a plane is judged by."""

FREE_M: Final = 0.05
"""What a reflected point costs that lies where the input view sees past the object, and most that any costs."""

NEARNESS: Final = 0.02
"""Weight of the distance to the seen points: without it the best plane is one far behind the object.
Of 0.02 to 1 the best on 20 scenes of deploy/jobs/tabletop.yaml."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """What is said of a pair, nothing where nothing is said.

    depth_m [H, W], metres, 0 in holes, and rgb [H, W, 3] of the mirror view. By region: shapes in the object's frame, metres,
    values [M] at its stored volume points, poses [4, 4], object to mirror camera.
    """

    depth_m: NDArray | None = None
    rgb: NDArray[np.uint8] | None = None
    shapes: Mapping[int, trimesh.Trimesh] = field(default_factory=dict)
    volumes: Mapping[int, NDArray] = field(default_factory=dict)
    poses: Mapping[int, NDArray] = field(default_factory=dict)


Predictor = Callable[[Pair], Prediction]


def write(folder: Path, pair: Pair, said: Prediction) -> None:
    """Puts a prediction into a folder as `verso score` reads it."""
    assert pair.mirror is not None
    name, files = f"{pair.mirror.pose_id:05d}", dict[str, Any]()
    if said.depth_m is not None:
        units = np.rint(said.depth_m * pair.mirror.depth_units_per_m)
        files[f"depth/{name}.png"] = encode_png(np.clip(units, 0, 65535).astype(np.uint16))
    if said.rgb is not None:
        files[f"rgb/{name}.png"] = encode_png(said.rgb)
    for region in regions_of(pair):
        stem = name + (f"obj{region - REGION_FIRST_OBJECT}" if region > REGION_FIRST_OBJECT else "")
        if region in said.shapes:
            files[f"shape/{stem}.ply"] = trimesh.exchange.ply.export_ply(said.shapes[region])
        if region in said.volumes:
            (folder / "volume").mkdir(parents=True, exist_ok=True)
            np.save(folder / "volume" / f"{stem}.npy", said.volumes[region])
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    if said.poses:
        table = folder / "poses.csv"
        lines = [] if table.exists() else ["scene_id,im_id,obj_id,R,t\n"]
        for region, T in said.poses.items():
            R, t = (" ".join(map(repr, part.ravel().tolist())) for part in (T[:3, :3], 1e3 * T[:3, 3]))
            lines.append(f"{pair.scene_id},{pair.mirror.pose_id},{region},{R},{t}\n")
        with table.open("a") as file:
            file.writelines(lines)


def regions_of(pair: Pair) -> list[int]:
    """The ids of a pair's objects."""
    return [region for region in sorted(pair.T_world) if region >= REGION_FIRST_OBJECT]


def mesh_of(pair: Pair, region: int) -> trimesh.Trimesh:
    """An object's closed surface in its own frame."""
    return pair.mesh(region, welded=True).apply_transform(np.linalg.inv(pair.T_world[region]))


def tell_truth(pair: Pair) -> Prediction:
    """What is stored of the mirror view."""
    mirror, regions = pair.mirror, regions_of(pair)
    assert mirror is not None
    return Prediction(
        depth_m=mirror.depth() / mirror.depth_units_per_m,
        rgb=mirror.rgb(),
        shapes={region: mesh_of(pair, region) for region in regions},
        volumes={region: pair.samples(region)["volume_distance"] for region in regions},
        poses={region: read_matrix(mirror.regions[region]["T_cam_obj"]) for region in regions},
    )


def project_input(pair: Pair) -> Prediction:
    """The points of the input view in the mirror view, one pixel each."""
    view, mirror = pair.input, pair.mirror
    assert mirror is not None
    projected = forward_project(view.depth(), view.camera, mirror.camera, 1, view.depth_units_per_m)
    colours = np.concatenate([view.rgb().reshape(-1, 3), np.zeros((1, 3), np.uint8)])  # -1 is a hole
    return Prediction(projected.depth_m, colours[projected.source])


def project_and_fill(pair: Pair) -> Prediction:
    """The same, a hole with what the nearest pixel that is none has."""
    projected = project_input(pair)
    assert projected.depth_m is not None and projected.rgb is not None
    filled = nearest_pixels(projected.depth_m)
    return Prediction(projected.depth_m[filled], projected.rgb[filled])


def nearest_pixels(depth_m: NDArray) -> tuple[NDArray, NDArray]:
    """(row, column), each [H, W], of the nearest pixel that has depth."""
    rows, columns = ndimage.distance_transform_edt(depth_m == 0, return_distances=False, return_indices=True)
    return rows, columns


def stand_plate(pair: Pair) -> Prediction:
    """A plate across the optical axis for each object, at the median depth of its seen points; a pixel has the nearest one's."""
    return spread(pair, lambda points: points * (np.median(points[:, 2]) / points[:, 2:]))


def turn_half(pair: Pair) -> Prediction:
    """The seen points of each object turned by half a turn (mirror_depth.py); a pixel has the nearest one's depth."""
    assert pair.mirror is not None
    up = pair.mirror.T_world_cam[2, :3]
    return spread(pair, lambda points: mirror_depth.half_turn(points, up))


def spread(pair: Pair, guess: Callable[[NDArray], NDArray]) -> Prediction:
    """The nearest depth of what is guessed of each object from its seen points, both [N, 3] in the mirror camera's frame."""
    view, mirror = pair.input, pair.mirror
    assert mirror is not None
    T, depth_m = np.linalg.inv(mirror.T_world_cam) @ view.T_world_cam, np.full(mirror.depth().shape, np.inf)
    seen_m, segment = view.depth_m(), view.segment()
    for region in regions_of(pair):
        points = mirror_depth.unproject(view, seen_m, segment == region)
        if len(points):
            points = guess(mirror_depth.transform(T, points))
            at = np.stack(mirror_depth.pixels_of(mirror, points))
            here = (at >= 0).all(axis=0) & (at < np.array(depth_m.shape)[:, None]).all(axis=0)
            np.minimum.at(depth_m, tuple(at[:, here]), points[here, 2])
    if not np.isfinite(depth_m).any():  # no object is seen
        return project_and_fill(pair)
    depth_m[np.isinf(depth_m)] = 0.0
    return Prediction(depth_m[nearest_pixels(depth_m)])


def complete_by_symmetry(pair: Pair) -> Prediction:
    """The seen points of each object and their reflections at the best upright plane; a pixel has the nearest one's depth."""
    view, mirror = pair.input, pair.mirror
    assert mirror is not None
    T_input_mirror = np.linalg.inv(view.T_world_cam) @ mirror.T_world_cam
    seen_m, up = view.depth_m(), mirror.T_world_cam[2, :3]

    def complete(points: NDArray) -> NDArray:
        some = points[:: len(points) // TRIED_POINTS + 1]
        rows, columns = mirror_depth.pixels_of(view, mirror_depth.transform(T_input_mirror, points))
        mask = np.zeros(seen_m.shape, bool)
        mask[rows.clip(0, mask.shape[0] - 1), columns.clip(0, mask.shape[1] - 1)] = True
        tree, best, least = cKDTree(points), points, np.inf
        for reflected in reflections(some, up):
            cost = NEARNESS * tree.query(reflected.points)[0].mean()
            if cost < least:
                there = mirror_depth.transform(T_input_mirror, reflected.points)
                cost += behind_what_is_seen(view, there, seen_m, mask)
                if cost < least:
                    best, least = reflected.all_of(points), cost
        return np.concatenate([points, best])

    return spread(pair, complete)


@dataclass(frozen=True, eq=False)
class Reflection:
    """Points [N, 3] reflected at the plane normal . x = offset_m."""

    points: NDArray
    normal: NDArray
    offset_m: float

    def all_of(self, points: NDArray) -> NDArray:
        """Other points reflected at the same plane."""
        return points - 2.0 * np.outer(points @ self.normal - self.offset_m, self.normal)


def reflections(points: NDArray, up: NDArray) -> Iterator[Reflection]:
    """Points [N, 3] reflected at upright planes of all directions, through them and beside them by their width."""
    level = np.linalg.svd(up[None])[2][1:]
    for angle in np.arange(ANGLES) * np.pi / ANGLES:
        normal = np.cos(angle) * level[0] + np.sin(angle) * level[1]
        low, high = np.percentile(points @ normal, [1, 99])
        for offset_m in np.linspace(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, SHIFTS):
            plane = Reflection(points, normal, float(offset_m))
            yield Reflection(plane.all_of(points), normal, float(offset_m))


def behind_what_is_seen(view: View, points: NDArray, seen_m: NDArray, mask: NDArray[np.bool_]) -> float:
    """How far points [N, 3], camera frame, are in the mean before the object's surface; `FREE_M` where the view sees past it."""
    rows, columns = mirror_depth.pixels_of(view, points)
    inside = (rows >= 0) & (columns >= 0) & (rows < mask.shape[0]) & (columns < mask.shape[1])
    at = rows[inside], columns[inside]
    before_m = seen_m[at] - points[inside, 2]
    cost = np.where(mask[at], before_m, np.where(before_m > 0.0, FREE_M, 0.0))
    return float(np.clip(cost, 0.0, FREE_M).sum() / len(points))

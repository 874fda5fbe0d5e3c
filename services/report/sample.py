"""Scenes chosen evenly from each category, with their pictures. Reads stored rows and images."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from schemas.dataset.codec import Row
from schemas.scene.shape import REGION_FIRST_OBJECT
from services.read.dataset_reader import ReadFile, StoredRange, file_reader, find_scene
from services.report.histogram import Histogram
from services.report.images import PairImages, metres_of, read_pair
from services.report.pictures import (
    Picture,
    depth_span,
    picture_of_colour,
    picture_of_depth,
    picture_of_projection,
    picture_of_regions,
)
from services.report.tables import Tables
from workers.store.store import Store

DEPTH_M = (0.0, 9.6)
"""Range of counted depth, metres: stored depth ends at 8 m by default."""


@dataclass(frozen=True)
class ShownScene:
    """One scene of the page: its pictures by name (`input rgb`, `mirror depth`, `over`), and what is told beside them."""

    scene_id: int
    category: str
    instances: tuple[str, ...]
    pose_id: int
    pictures: Mapping[str, Picture]
    visible: Mapping[str, float | None]
    """Visible fraction of the object by role."""
    d_z_m: float | None


@dataclass(frozen=True)
class Sample:
    """The scenes that a page shows, in order of category, and the depth of their object pixels by role."""

    scenes: tuple[ShownScene, ...]
    depth: Mapping[str, Histogram]


def choose_scenes(tables: Tables, by_category: Mapping[str, int], scenes: int) -> list[int]:
    """About `scenes` scene ids, equally many of each category as far as there are, each category's evenly over its ids."""
    each = _shares(by_category, scenes)
    wanted = {
        category: {int((i + 0.5) * by_category[category] / count) for i in range(count)}
        for category, count in each.items()
    }
    seen = dict.fromkeys(by_category, 0)
    chosen: dict[str, list[int]] = {category: [] for category in by_category}
    for rows in tables.batches("scenes", ("scene_id", "category")):
        ids = rows.column("scene_id").to_numpy()
        names = np.asarray(rows.column("category").to_pylist())
        for category in np.unique(names).tolist():
            of = ids[names == category]
            first = seen.get(category, 0)
            chosen[category] += [int(of[at - first]) for at in wanted[category] if first <= at < first + len(of)]
            seen[category] = first + len(of)
    return [scene_id for category in sorted(chosen) for scene_id in sorted(chosen[category])]


def _shares(by_category: Mapping[str, int], scenes: int) -> dict[str, int]:
    """How many of each category; at least one of each."""
    shares = dict.fromkeys(by_category, 0)
    while sum(shares.values()) < scenes or 0 in shares.values():
        open_ones = [name for name in shares if shares[name] < by_category[name]]
        if not open_ones:
            break
        least = min(open_ones, key=lambda name: shares[name])
        shares[least] += 1
    return shares


def show_scenes(store: Store, scene_ids: Iterable[int]) -> Sample:
    """The pictures of these scenes. Raises CorruptError where an image is missing or damaged."""
    shown, depth = [], {role: Histogram(*DEPTH_M) for role in ("input", "mirror")}
    for scene_id in scene_ids:
        stored = find_scene(store, scene_id)
        row = stored.scene(scene_id)
        if row is not None:
            shown.append(show_scene(file_reader(store.read, stored), stored, row, depth))
    return Sample(tuple(shown), depth)


def show_scene(read: ReadFile, stored: StoredRange, scene: Row, depth: dict[str, Histogram]) -> ShownScene:
    """The pictures of a scene's first pair; the depth of its objects is added to `depth`."""
    views, _ = next(stored.pairs(scene["scene_id"]))
    images = read_pair(read, views)
    pictures: dict[str, Picture] = {}
    for role in ("input", "mirror"):
        pictures |= _view_pictures(role, images, views)
        if {(role, "depth"), (role, "region")} <= images.keys():
            metres = metres_of(images[role, "depth"], views[role])
            depth[role] = depth[role].add(metres[(images[role, "region"] >= REGION_FIRST_OBJECT) & (metres > 0)])
    mirror, projected = images.get(("mirror", "rgb")), images.get(("projected", "rgb"))
    if mirror is not None and projected is not None:
        pictures["over"] = picture_of_projection(mirror, projected, "input view projected over the mirror view")
    bodies = scene["bodies"] or [scene]
    first = views["input"]
    return ShownScene(
        scene["scene_id"],
        scene["category"],
        tuple(body["instance_id"] for body in bodies),
        first["pose_id"],
        pictures,
        {role: views[role]["visible_fraction"] for role in ("input", "mirror") if role in views},
        first["d_z_m"],
    )


def _view_pictures(role: str, images: PairImages, views: Mapping[str, Row]) -> dict[str, Picture]:
    pictures = {}
    if (rgb := images.get((role, "rgb"))) is not None:
        pictures[f"{role} rgb"] = picture_of_colour(rgb, f"{role} view, colour")
    if (depth := images.get((role, "depth"))) is not None:
        metres = metres_of(depth, views[role])
        low, high = span = depth_span(metres, images.get((role, "region")))
        pictures[f"{role} depth"] = picture_of_depth(metres, span, f"{role} view, depth {low:.2f} to {high:.2f} m")
    if (regions := images.get((role, "region"))) is not None:
        pictures[f"{role} mask"] = picture_of_regions(regions, f"{role} view, regions")
    return pictures

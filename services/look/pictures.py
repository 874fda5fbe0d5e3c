"""Scenes chosen evenly from each category, and pictures of their stored images."""

import base64
import hashlib
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.color import interpolate

from schemas.dataset.codec import Row
from schemas.dataset.layout import patch_index
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR
from services.look.charts import Histogram
from services.look.collect import Tables
from services.read.dataset_reader import ReadFile, StoredRange, file_reader, find_scene, read_image
from services.read.stored_tables import patch_paths, view_paths
from workers.store.store import Store

MOST_WIDTH = 480
"""Wider images are shrunk to this for the page, pixels."""

JPEG_QUALITY = 82

DEPTH_STRETCH = (1.0, 99.0)
"""Percentiles of depth that get the first and the last colour."""

DIMMED = 0.35
"""Brightness of the mirror view below the projection, where nothing was projected."""

FIXED_REGIONS = ((24, 26, 30), (203, 205, 209), (139, 144, 153))
"""Nothing, floor, table."""

OBJECT_REGIONS = ((46, 111, 197), (224, 123, 57), (62, 146, 104), (160, 84, 160), (196, 160, 42), (72, 165, 178))
"""Objects in turn, told apart also by those who do not see red and green alike."""


@dataclass(frozen=True)
class Picture:
    """An encoded picture with its size in pixels and what it shows in words."""

    data: bytes
    kind: str
    """`jpeg` or `png`."""
    width: int
    height: int
    words: str

    @property
    def name(self) -> str:
        """A file name that follows from the content."""
        return f"{hashlib.sha256(self.data).hexdigest()[:24]}.{self.kind}"

    @property
    def inline(self) -> str:
        """A `data:` address."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.data).decode('ascii')}"


def picture_of_colour(rgb: NDArray[np.uint8], words: str) -> Picture:
    """An RGB image as JPEG."""
    return _jpeg(Image.fromarray(rgb), words)


@cache
def viridis() -> NDArray[np.uint8]:
    """[256, 3] RGB, from dark violet to yellow."""
    return np.asarray(interpolate(np.arange(256), "viridis", dtype=np.uint8)[:, :3])


def picture_of_depth(depth_m: NDArray, span_m: tuple[float, float], words: str) -> Picture:
    """Depth in viridis, near is yellow; pixels without depth (0) are black. `span_m`: depth of first and last colour."""
    low, high = span_m
    share = np.clip((depth_m - low) / max(high - low, 1e-6), 0.0, 1.0)
    rgb = viridis()[(255 * (1.0 - share)).astype(np.uint8)]
    return _jpeg(Image.fromarray(np.where(depth_m[..., None] > 0, rgb, np.uint8(0))), words)


def depth_span(depth_m: NDArray, regions: NDArray | None = None) -> tuple[float, float]:
    """The depth of the first and the last colour, metres: of the table and what stands on it, as far as regions are known.

    (0, 0) where there is no depth.
    """
    known = depth_m > 0
    above = known if regions is None else known & (regions > REGION_FLOOR)
    values = depth_m[above if above.any() else known]
    low, high = np.percentile(values, DEPTH_STRETCH) if values.size else (0.0, 0.0)
    return float(low), float(high)


def picture_of_regions(regions: NDArray[np.uint8], words: str) -> Picture:
    """Each region in its colour, as PNG, whose edges stay sharp."""
    image = Image.fromarray(np.minimum(regions, 255), "L")
    image = image.resize(_size_of(image), Image.Resampling.NEAREST)
    image.putpalette(_palette())
    sink = io.BytesIO()
    image.save(sink, "PNG", optimize=True)
    return Picture(sink.getvalue(), "png", image.width, image.height, words)


def picture_of_projection(mirror: NDArray[np.uint8], projected: NDArray[np.uint8], words: str) -> Picture:
    """What the input view knows of the mirror view, bright over the dimmed mirror view."""
    known = (projected > 0).any(axis=-1, keepdims=True)
    dimmed = (mirror * DIMMED).astype(np.uint8)
    return _jpeg(Image.fromarray(np.where(known, projected, dimmed)), words)


def _jpeg(image: Image.Image, words: str) -> Picture:
    size = _size_of(image)
    if size != image.size:
        image = image.resize(size, Image.Resampling.BOX)
    sink = io.BytesIO()
    image.save(sink, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return Picture(sink.getvalue(), "jpeg", *size, words)


def _size_of(image: Image.Image) -> tuple[int, int]:
    width = min(image.width, MOST_WIDTH)
    return width, max(1, round(image.height * width / image.width))


def _palette() -> list[int]:
    objects = np.resize(np.array(OBJECT_REGIONS), (256 - REGION_FIRST_OBJECT, 3))
    return [int(value) for value in np.concatenate([np.array(FIXED_REGIONS), objects]).ravel()]


PairImages: TypeAlias = Mapping[tuple[str, str], NDArray]
"""Images by role (input, mirror, projected) and kind of pixels (rgb, depth, region), as far as they are stored."""


def read_pair(read: ReadFile, views: Mapping[str, Row]) -> PairImages:
    """The stored images of a pair but for aligned ones. Raises CorruptError where one is missing or damaged."""
    return {
        (role, kind): read_image(read, path)
        for role, row in views.items()
        if role != "aligned"
        for kind, path in view_paths(row).items()
    }


def metres_of(depth: NDArray, view: Row) -> NDArray:
    """[H, W] float64, metres; 0 where there is no depth."""
    metres: NDArray = depth / view["depth_units_per_m"]
    return metres


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
        pictures |= _patch_pictures(read, role, views, len(scene["bodies"] or [scene]))
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


def _patch_pictures(read: ReadFile, role: str, views: Mapping[str, Row], objects: int) -> dict[str, Picture]:
    """The stored crop of a view about the scene's first object: its colours, or its depth."""
    paths = patch_paths(views[role], patch_index(REGION_FIRST_OBJECT, objects)) if role in views else {}
    name, words = f"{role} patch", f"{role} view, patch about the object"
    if "rgb" in paths:
        return {name: picture_of_colour(read_image(read, paths["rgb"]), words)}
    if "depth" in paths:
        metres = metres_of(read_image(read, paths["depth"]), views[role])
        return {name: picture_of_depth(metres, depth_span(metres), words)}
    return {}


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

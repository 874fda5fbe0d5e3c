"""Scenes chosen evenly from each category, and pictures of their stored images."""

import base64
import hashlib
import io
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import cycle

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter
from trimesh.visual.color import interpolate

from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, is_object
from schemas.scene.view import MODALITIES, PixelKind
from services.dataset.dataset import Dataset
from services.dataset.pair import NamedViews, Pair
from services.dataset.view import Pixels
from services.look.charts import DEPTH_M, Histogram
from services.read.dataset_reader import StoredTables, kinds_of
from services.read.query import query
from workers.geometry.camera import spread_evenly
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

SHOWN_ROLES = ("input", "mirror")
"""Views that are shown beside one another."""

PATCH, ABOUT = " patch", "patch about the object"
"""Ends the name of a patch's picture, and the words for it."""

CHEQUERS, CHEQUERED = (114, 126), 16
"""The greys behind transparent pictures, from which white, grey and black things differ, and how many squares are in a row."""

STRIP_WIDTH, STRIP_COLUMNS, STRIP_ROWS, GAP = 960, 6, 2, 2
"""Of a strip of a named camera's views: pixels, how many views stand beside and below one another at most, pixels between."""

TURNED_WIDTH, MOST_TURNED, ROUND_MS = 280, 60, 4000
"""Of a turning picture: pixels, views at most, and milliseconds that one round takes."""

MOST_STEP_RAD, FEWEST_TURNED = 1.6, 4
"""Views whose optical axes turn by at most this from each to the next, so many at least, go round."""

PLAIN = tuple(name for name, modality in MODALITIES.items() if modality.target is None)
"""Modalities that are no targets."""


@dataclass(frozen=True)
class Picture:
    """An encoded picture with its size in pixels and what it shows in words."""

    data: bytes
    kind: str
    """`jpeg`, `png` or `webp`."""
    width: int
    height: int
    words: str

    @property
    def name(self) -> str:
        """A file name that follows from the content."""
        return f"{hashlib.sha256(self.data).hexdigest()[:24]}.{self.kind}"

    @property
    def caption(self) -> str:
        """The words in short, for below the picture."""
        return self.words.replace(" view, ", " · ").replace("colour", "RGB").removesuffix(f", {ABOUT}")

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


def picture_of_depth(depth_m: NDArray, span_m: tuple[float, float], words: str, sharp: bool = False) -> Picture:
    """Depth in viridis, near is yellow; pixels without depth (0) are black. `span_m`: depth of first and last colour.

    `sharp`: as PNG, for thin parts, whose colours JPEG loses.
    """
    low, high = span_m
    share = np.clip((depth_m - low) / max(high - low, 1e-6), 0.0, 1.0)
    rgb = viridis()[(255 * (1.0 - share)).astype(np.uint8)]
    image = Image.fromarray(np.where(depth_m[..., None] > 0, rgb, np.uint8(0)))
    return (_png if sharp else _jpeg)(image, words)


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
    return _png(Image.fromarray(np.minimum(regions, 255), "L"), words, _palette())


def picture_of_codes(codes: NDArray[np.uint16], words: str) -> Picture:
    """[H, W, 3] of 16 bits as colours, red first: normals and coordinates, as they are usually shown; PNG."""
    return _png(Image.fromarray((codes >> 8).astype(np.uint8)), words)


def picture_of_silhouettes(masks: Sequence[NDArray[np.uint8]], under: NDArray[np.uint8], words: str) -> Picture:
    """The outline of each object's mask [H, W] in the object's colour, over an image [H, W, 3] of RGB."""
    shown = under.copy()
    for mask, color in zip(masks, cycle(OBJECT_REGIONS)):
        inner = np.asarray(Image.fromarray(mask).filter(ImageFilter.MinFilter(3)))
        shown[mask > inner] = color
    return _jpeg(Image.fromarray(shown), words, subsampling=0)  # thin lines keep their colour


def picture_of_projection(mirror: NDArray[np.uint8], projected: NDArray[np.uint8], words: str) -> Picture:
    """What the input view knows of the mirror view, bright over the dimmed mirror view."""
    known = (projected > 0).any(axis=-1, keepdims=True)
    dimmed = (mirror * DIMMED).astype(np.uint8)
    return _jpeg(Image.fromarray(np.where(known, projected, dimmed)), words)


def _jpeg(image: Image.Image, words: str, subsampling: int = 2) -> Picture:
    sink = io.BytesIO()
    image.save(sink, "JPEG", quality=JPEG_QUALITY, optimize=True, subsampling=subsampling)
    return Picture(sink.getvalue(), "jpeg", image.width, image.height, words)


def _png(image: Image.Image, words: str, palette: Sequence[int] = ()) -> Picture:
    if palette:
        image.putpalette(palette)
    sink = io.BytesIO()
    image.save(sink, "PNG", optimize=True)
    return Picture(sink.getvalue(), "png", image.width, image.height, words)


def flatten(pixels: NDArray) -> NDArray:
    """Colours with alpha [H, W, 4] over grey chequers, as RGB [H, W, 3]; any other image as it is."""
    if pixels.ndim < 3 or pixels.shape[2] < 4:
        return pixels
    rows, columns = np.indices(pixels.shape[:2]) * CHEQUERED // pixels.shape[1]
    ground = np.take(CHEQUERS, (rows + columns) % 2)[..., None]
    return np.rint(ground + (pixels[..., :3] - ground) * (pixels[..., 3:] / 255.0)).astype(np.uint8)


def shrink(pixels: NDArray, width: int = MOST_WIDTH) -> NDArray:
    """An image at most so many pixels wide: colours are averaged, of depths, regions and codes some are left out."""
    if pixels.shape[1] <= width:
        return pixels
    height = max(1, round(pixels.shape[0] * width / pixels.shape[1]))
    if pixels.ndim == 3 and pixels.dtype == np.uint8:
        return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))
    rows, columns = (np.arange(n) * whole // n for n, whole in zip((height, width), pixels.shape[:2], strict=True))
    return pixels[rows[:, None], columns]


def _palette() -> list[int]:
    objects = np.resize(np.array(OBJECT_REGIONS), (256 - REGION_FIRST_OBJECT, 3))
    return [int(value) for value in np.concatenate([np.array(FIXED_REGIONS), objects]).ravel()]


@dataclass(frozen=True)
class ShownCamera:
    """The views of a camera that the job names."""

    name: str
    views: int
    """How many there are."""
    shown: int
    """How many of them the strips have, evenly chosen."""
    strips: Mapping[str, Picture]
    """Views beside and below one another, by name (`around rgb`)."""
    turning: Picture | None
    """One after another, where they go round step by step."""


@dataclass(frozen=True)
class ShownScene:
    """One scene of the page: its pictures by name (`input rgb`, `mirror normals patch`, `over`), and what is told beside them."""

    scene_id: int
    category: str
    instances: tuple[str, ...]
    pose_id: int
    pictures: Mapping[str, Picture]
    visible: Mapping[str, float | None]
    """Visible fraction of the object by role."""
    d_z_m: float | None
    cameras: Sequence[ShownCamera] = ()
    """Those that the job names."""


def choose_scenes(tables: StoredTables, scenes: int) -> list[int]:
    """At most `scenes` scene ids, equally many of each category, evenly over its ids; at least one of each."""
    sql = "select list(scene_id order by scene_id) as ids from scenes group by category order by category"
    by_category = query(tables, sql)["ids"].to_pylist()
    each = max(1, scenes // max(len(by_category), 1))
    return [ids[place] for ids in by_category for place in spread_evenly(len(ids), each)]


def show_scenes(
    store: Store, scene_ids: Iterable[int], kinds: Collection[PixelKind] | None = None
) -> tuple[list[ShownScene], Mapping[str, Histogram]]:
    """The pictures of these scenes, of these modalities or of all, and the depth of their object pixels by role, metres.

    Raises CorruptError where an image is missing or damaged.
    """
    dataset, depth = Dataset(store), {role: Histogram(*DEPTH_M) for role in SHOWN_ROLES}
    return [show_pair(pairs[0], depth, kinds) for scene_id in scene_ids if (pairs := dataset.scene(scene_id))], depth


def show_pair(pair: Pair, depth: dict[str, Histogram], kinds: Collection[PixelKind] | None = None) -> ShownScene:
    """The pictures of a scene by its first pair, of these modalities or of all; the depth of its objects is added to `depth`."""
    pictures: dict[str, Picture] = {}
    for role in (role for role in SHOWN_ROLES if role in pair.views):
        view = pair.views[role]
        whole, units_per_m = _read_images(view, kinds), view.depth_units_per_m
        pictures |= view_pictures(role, whole, units_per_m)
        if (patch := view.patch()) is not None:
            plain = [kind for kind in ("rgb", "depth") if kind in patch.images and (kinds is None or kind in kinds)][:1]
            has_targets = kinds is None and set(patch.images) - set(PLAIN)
            pictures |= view_pictures(role, _read_images(patch, None if has_targets else plain), units_per_m, PATCH)
        if {"depth", "region"} <= whole.keys():
            of_objects = is_object(whole["region"]) & (whole["depth"] > 0)
            depth[role] = depth[role].add(whole["depth"][of_objects] / units_per_m)
    if pair.mirror is not None and pair.projected is not None and "rgb" in pair.projected.images:
        over = "input view projected over the mirror view"
        pictures["over"] = picture_of_projection(shrink(pair.mirror.rgb()), shrink(pair.projected.rgb()), over)
    names = dict.fromkeys(view.role for view in pair.views.values() if view.number is not None)
    return ShownScene(
        pair.scene_id,
        pair.category,
        tuple(body["instance_id"] for body in pair.scene["bodies"] or [pair.scene]),
        pair.pose_id,
        pictures,
        {role: pair.views[role].visible_fraction for role in SHOWN_ROLES if role in pair.views},
        pair.input.d_z_m,
        [show_camera(pair.views(name), kinds) for name in names],
    )


def show_camera(views: NamedViews, kinds: Collection[PixelKind] | None = None) -> ShownCamera:
    """The pictures of a named camera, of these modalities or of all."""
    count = min(len(views), STRIP_ROWS * STRIP_COLUMNS)
    columns = min(count // 2, STRIP_COLUMNS) if count > STRIP_COLUMNS else count
    chosen = [views[place] for place in spread_evenly(len(views), count - count % columns)]
    read = [_read_images(view, kinds) for view in chosen]
    tile = min(MOST_WIDTH, STRIP_WIDTH // columns - GAP)
    strips = {kind: _tiled([shrink(images[kind], tile) for images in read], columns) for kind in read[0]}
    name, units_per_m = chosen[0].role, chosen[0].depth_units_per_m
    return ShownCamera(
        name, len(views), len(chosen), view_pictures(name, strips, units_per_m, width=STRIP_WIDTH), _turning(views)
    )


def _tiled(images: Sequence[NDArray], columns: int) -> NDArray:
    """Images beside and below one another, in rows of so many; 0 between them and beside smaller ones."""
    height, width = (max(sizes) + GAP for sizes in zip(*(image.shape[:2] for image in images), strict=True))
    tiled = np.zeros((height * (len(images) // columns), width * columns, *images[0].shape[2:]), images[0].dtype)
    for place, image in enumerate(images):
        top, left = height * (place // columns), width * (place % columns)
        tiled[top : top + image.shape[0], left : left + image.shape[1]] = image
    return tiled


def _turning(views: NamedViews) -> Picture | None:
    """The views one after another as a WebP that moves; None where they do not go round, step by step, and without RGB."""
    axes = views.T_world_cam[:, :3, 2]
    steps = np.arccos(np.clip(np.einsum("ij,ij->i", axes, np.roll(axes, -1, axis=0)), -1.0, 1.0))
    if len(axes) < FEWEST_TURNED or steps.max() > MOST_STEP_RAD or "rgb" not in views[0].images:
        return None
    chosen = [views[place].image("rgb") for place in spread_evenly(len(views), MOST_TURNED)]
    first, *others = (Image.fromarray(shrink(flatten(pixels), TURNED_WIDTH)) for pixels in chosen)
    if any(image.size != first.size for image in others):
        return None
    sink, each_ms = io.BytesIO(), ROUND_MS // len(chosen)
    first.save(sink, "WEBP", save_all=True, append_images=others, duration=each_ms, loop=0, quality=JPEG_QUALITY)
    return Picture(sink.getvalue(), "webp", *first.size, f"{views[0].role} view, turning")


def _read_images(pixels: Pixels, kinds: Collection[PixelKind] | None) -> dict[PixelKind, NDArray]:
    return {kind: flatten(pixels.image(kind)) for kind in pixels.images if kinds is None or kind in kinds}


def view_pictures(
    role: str, images: Mapping[PixelKind, NDArray], units_per_m: float, suffix: str = "", width: int = MOST_WIDTH
) -> dict[str, Picture]:
    """The pictures of a view's images, or of its patches, by name, at most so many pixels wide.

    Depths of one series have the same span of colours.
    """
    there = {
        kind: [shrink(images[name], width) for name in names]
        for kind in MODALITIES
        if (names := kinds_of(kind, images))
    }
    pictures = {}
    for kinds in series_of(there).values():
        span = _span_of(kinds, there, units_per_m)
        for kind in kinds:
            words = words_of(kind)
            if span:
                words += f"{'' if kind == 'depth' else ','} {span[0]:.2f} to {span[1]:.2f} m"
            if suffix:
                words = f"{words}, {ABOUT}" if len(there) > 1 else ABOUT
            pictures[f"{role} {kind}{suffix}"] = _paint(kind, there, units_per_m, span, f"{role} view, {words}")
    return pictures


def _span_of(
    kinds: Sequence[PixelKind], there: Mapping[PixelKind, list[NDArray]], units_per_m: float
) -> tuple[float, float] | None:
    """The span of the colours of depths, metres; None for other images. Targets are depths of objects alone."""
    modality = MODALITIES[kinds[0]]
    if modality.channels > 1 or modality.dtype == "uint8":
        return None
    regions = there["region"][0] if modality.target is None and "region" in there else None
    return depth_span(np.stack([there[kind][0] for kind in kinds]) / units_per_m, regions)


def _paint(
    kind: PixelKind,
    there: Mapping[PixelKind, list[NDArray]],
    units_per_m: float,
    span: tuple[float, float] | None,
    words: str,
) -> Picture:
    """A modality's picture, as the type of its pixels says."""
    modality, pixels = MODALITIES[kind], there[kind][0]
    if modality.each or not modality.of_input:
        regions = np.array(_palette(), np.uint8).reshape(-1, 3)
        under = there["rgb"][0] if "rgb" in there else regions[there["region"][0]]
        if modality.each:
            return picture_of_silhouettes(there[kind], under, words)
        return picture_of_projection(under, under * (pixels > 0)[..., None], words)
    if span is not None:
        return picture_of_depth(pixels / units_per_m, span, words, sharp=modality.target is not None)
    if modality.channels == 1:
        return picture_of_regions(pixels, words)
    return picture_of_colour(pixels, words) if modality.dtype == "uint8" else picture_of_codes(pixels, words)


def series_of(kinds: Collection[PixelKind]) -> dict[str, tuple[PixelKind, ...]]:
    """These modalities by what a button calls them: one each, but together those of one target that have such pixels."""
    groups: dict[tuple[str, str, int], list[PixelKind]] = {}
    for name, modality in MODALITIES.items():
        if name in kinds:
            groups.setdefault((modality.target or name, modality.dtype, modality.channels), []).append(name)
    named = {}
    for (target, dtype, _), group in groups.items():
        several = f"regions of {target}" if dtype == "uint8" else target
        named[several if len(group) > 1 else words_of(group[0]).replace("colour", "RGB")] = tuple(group)
    return named


def words_of(kind: PixelKind) -> str:
    """`colour` of `rgb`, `regions` of `region`, `layer 1 region` of `layer1_region`."""
    spaced = re.sub(r"(?<=[a-z])(?=\d)", " ", kind.replace("_", " "))
    return {"rgb": "colour", "region": "regions"}.get(kind, spaced)

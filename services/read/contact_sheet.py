"""`verso sheet`: one page with images of a dataset's scenes."""

import argparse
import json
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from schemas.dataset.codec import Row, read_world_poses
from schemas.dataset.layout import Content, image_path, patch_index, patch_path
from schemas.errors import InputError
from schemas.scene.shape import REGION_FIRST_OBJECT
from services.read.dataset_reader import ReadFile, StoredRange, file_reader, iter_stored, read_image
from workers.store.store import Store, open_store

CELL = (256, 192)
"""Width and height of a picture on the sheet, pixels."""

MARGIN = 4
HEADING = 26
LEFT = 92
EMPTY = "#f5f5f5"

COLUMNS = (
    *("input RGB", "input depth", "input mask", "mirror RGB", "mirror depth", "mirror mask"),
    *("projected RGB", "patches"),
)

REGION_COLORS = ("white", "#cdcdcd", "#a07850", "#e64628")
"""Nothing, floor, table, first object."""

MORE_COLORS = ("#2d6ec8", "#3ca046", "#f0b41e", "#8c46aa", "#1eaab4", "#dc6eaa", "#6e5a28")
"""Further objects, in turn."""

DEPTH_STRETCH = (2.0, 98.0)
"""Percentiles of depth that get the nearest and the farthest colour."""

MOST_PATCHES = 4
"""Largest number of objects whose patches are drawn."""


def draw_sheet(store: Store, scenes: int, category: str | None = None) -> Image.Image:
    """A row for each of the first scenes of every category (or of one), with its first pair's images.

    Raises InputError where there are none.
    """
    rows = _choose(store, scenes, category)
    if not rows:
        what = f"no scene of category {category!r}" if category else "no scene"
        raise InputError(f"{store.name} has {what} yet: `verso status {store.name}` tells which there are")
    width, height = CELL[0] + MARGIN, CELL[1] + MARGIN
    page = Image.new("RGB", (LEFT + len(COLUMNS) * width, HEADING + len(rows) * height), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(15)
    for column, title in enumerate(COLUMNS):
        pen.text((LEFT + column * width + 4, 5), title, "black", font)
    for number, (name, cells) in enumerate(rows):
        top = HEADING + number * height
        pen.text((6, top + 6), name, "black", font)
        for column, cell in enumerate(cells):
            page.paste(cell, (LEFT + column * width, top))
    return page


def _choose(store: Store, scenes: int, only: str | None) -> list[tuple[str, list[Image.Image]]]:
    """The cells of the first scenes of each category, by category."""
    chosen: dict[str, list[list[Image.Image]]] = {}
    for stored in iter_stored(store):
        read = file_reader(store.read, stored)
        for scene in stored.rows["scenes"]:
            category = scene["category"]
            if only in (None, category) and len(chosen.setdefault(category, [])) < scenes:
                chosen[category].append(_draw_cells(read, stored, scene))
    return [(category, cells) for category in sorted(chosen) for cells in chosen[category]]


def _draw_cells(read: ReadFile, stored: StoredRange, scene: Row) -> list[Image.Image]:
    """The cells of one scene's first pair."""
    views, _ = next(stored.pairs(scene["scene_id"]))
    e, category = views["input"]["pose_id"], scene["category"]
    listed = {file["path"] for row in views.values() for file in row["files"]}

    def cell(content: Content, number: int, paint: Callable[[NDArray], Image.Image] = Image.fromarray) -> Image.Image:
        path = image_path(category, content, number)
        if path not in listed:
            return Image.new("RGB", CELL, EMPTY)
        return paint(read_image(read, path)).resize(CELL, Image.Resampling.BOX)

    cells = []
    for number in (e, e + 1):
        cells += [cell("RGB", number), cell("depth", number, _paint_depth), cell("segment", number, _paint_regions)]
    regions = [region for region in read_world_poses(scene) if region >= REGION_FIRST_OBJECT]
    indices = [patch_index(region, len(regions)) for region in regions[:MOST_PATCHES]]
    paths = [patch_path(category, "RGB", number, index) for index in indices for number in (e, e + 1)]
    return [*cells, cell("RGBprojected", e), _stack([read_image(read, path) for path in paths if path in listed])]


def _stack(patches: list[NDArray]) -> Image.Image:
    """Up to two patches above each other at their own size; more of them side by side, shrunk to the cell."""
    cell = Image.new("RGB", CELL, EMPTY)
    for number, patch in enumerate(patches):
        share = CELL[0] // ((len(patches) + 1) // 2)
        picture = Image.fromarray(patch)
        picture.thumbnail((share, CELL[1] // 2), Image.Resampling.BOX)
        cell.paste(picture, (number // 2 * share + (share - picture.width) // 2, number % 2 * picture.height))
    return cell


def _paint_depth(depth: NDArray) -> Image.Image:
    """Near is warm, far is cold, no depth is black."""
    known = depth > 0
    low, high = np.percentile(depth[known], DEPTH_STRETCH) if known.any() else (0.0, 0.0)
    share = np.clip((depth - low) / max(high - low, 1.0), 0.0, 1.0)
    bgr = cv2.applyColorMap((255 * (1.0 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)
    return Image.fromarray(np.where(known[..., None], bgr[..., ::-1], np.uint8(0)))


def _paint_regions(region: NDArray) -> Image.Image:
    colors = np.array([ImageColor.getrgb(color) for color in (*REGION_COLORS, *MORE_COLORS)], np.uint8)
    first, further = np.split(colors, [len(REGION_COLORS)])
    return Image.fromarray(np.concatenate([first, np.resize(further, (256 - len(first), 3))])[region])


def main(options: argparse.Namespace) -> int:
    """`verso sheet`. Raises InputError where no scene is there to draw, or the picture cannot be written."""
    sheet = draw_sheet(open_store(options.out), options.scenes, options.category)
    try:
        sheet.save(options.file, quality=88)  # which PNG has no use for
    except (OSError, ValueError) as error:
        raise InputError(f"{options.file}: cannot be written as a picture: {error}; name it .jpg or .png") from error
    print(f"{options.file}: {sheet.width} x {sheet.height} pixels")
    if options.json:
        print(json.dumps({"ok": True, "file": str(options.file)}))
    return 0

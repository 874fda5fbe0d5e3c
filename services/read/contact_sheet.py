"""Contact sheets: one page with images of a dataset's scenes.

python -m services.read.contact_sheet OUT FILE.jpg [SCENES [CATEGORY]]
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from schemas.dataset.codec import Row, read_world_poses
from schemas.dataset.layout import Content, image_path, patch_index, patch_path
from schemas.scene.region import REGION_FIRST_OBJECT
from services.read.dataset_reader import StoredRange, file_reader, iter_stored, read_image
from workers.store.local import open_store
from workers.store.store import Store

CELL = (256, 192)
"""Width and height of a picture on the sheet, pixels."""

MARGIN = 4
HEADING = 26
LEFT = 92

COLUMNS = (
    "input RGB",
    "input depth",
    "input mask",
    "mirror RGB",
    "mirror depth",
    "mirror mask",
    "projected RGB",
    "patches",
)

REGION_COLORS = np.array([[255, 255, 255], [205, 205, 205], [160, 120, 80], [230, 70, 40]], np.uint8)
"""Nothing, floor, table, first object."""

MORE_COLORS = np.array(
    [[45, 110, 200], [60, 160, 70], [240, 180, 30], [140, 70, 170], [30, 170, 180], [220, 110, 170], [110, 90, 40]],
    np.uint8,
)
"""Further objects, in turn."""

DEPTH_STRETCH = (2.0, 98.0)
"""Percentiles of depth that get the nearest and the farthest colour."""

MOST_PATCHES = 4
"""Largest number of objects whose patches are drawn."""

Picture = NDArray[np.uint8]


def draw_sheet(store: Store, scenes: int, category: str | None = None) -> Picture:
    """[H, W, 3] uint8: a row for each of the first scenes of every category (or of one), with its first pair's images."""
    rows = _choose(store, scenes, category)
    width = LEFT + len(COLUMNS) * (CELL[0] + MARGIN)
    page = Image.new("RGB", (width, HEADING + len(rows) * (CELL[1] + MARGIN)), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(15)
    for column, title in enumerate(COLUMNS):
        pen.text((LEFT + column * (CELL[0] + MARGIN) + 4, 5), title, "black", font)
    for number, (category, cells) in enumerate(rows):
        top = HEADING + number * (CELL[1] + MARGIN)
        pen.text((6, top + 6), category, "black", font)
        for column, cell in enumerate(cells):
            page.paste(Image.fromarray(cell), (LEFT + column * (CELL[0] + MARGIN), top))
    return np.asarray(page)


def _choose(store: Store, scenes: int, only: str | None) -> list[tuple[str, list[Picture]]]:
    """The first scenes of each category, by category."""
    chosen: dict[str, list[list[Picture]]] = {}
    for stored in iter_stored(store):
        read = file_reader(store.read, stored)
        for scene in stored.rows["scenes"]:
            category = scene["category"]
            if only not in (None, category):
                continue
            if len(chosen.setdefault(category, [])) < scenes:
                chosen[category].append(_cells(read, stored, scene))
    return [(category, cells) for category in sorted(chosen) for cells in chosen[category]]


def _cells(read: Callable[[str], bytes], stored: StoredRange, scene: Row) -> list[Picture]:
    """The cells of one scene's first pair."""
    views = [row for row in stored.rows["views"] if row["scene_id"] == scene["scene_id"]]
    e, category = min(row["parent_id"] for row in views), scene["category"]
    listed = {file["path"] for row in views for file in row["files"]}

    def cell(content: Content, number: int, paint: Callable[[NDArray], NDArray] = np.asarray) -> Picture:
        path = image_path(category, content, number)
        return _fit(paint(read_image(read, path))) if path in listed else _empty()

    cells = []
    for number in (e, e + 1):
        cells.append(cell("RGB", number))
        cells.append(cell("depth", number, _paint_depth))
        cells.append(cell("segment", number, _paint_regions))
    cells.append(cell("RGBprojected", e))
    regions = [region for region in read_world_poses(scene) if region >= REGION_FIRST_OBJECT]
    indices = [patch_index(region, len(regions)) for region in regions[:MOST_PATCHES]]
    patches = [patch_path(category, "RGB", number, index) for index in indices for number in (e, e + 1)]
    cells.append(_stack([read_image(read, path) for path in patches if path in listed]))
    return cells


def _empty() -> Picture:
    """The cell of an image that does not exist."""
    return np.full((CELL[1], CELL[0], 3), 245, np.uint8)


def _fit(picture: NDArray) -> Picture:
    return np.asarray(cv2.resize(picture, CELL, interpolation=cv2.INTER_AREA), np.uint8)


def _stack(patches: list[NDArray]) -> Picture:
    """Up to two patches above each other at their own size; more of them side by side, shrunk to the cell."""
    cell = _empty()
    columns = (len(patches) + 1) // 2
    for number, patch in enumerate(patches):
        share = CELL[0] // columns
        size = (
            min(share, patch.shape[1]),
            min(CELL[1] // 2, patch.shape[0] * min(share, patch.shape[1]) // patch.shape[1]),
        )
        top, left = (number % 2) * size[1], (number // 2) * share + (share - size[0]) // 2
        cell[top : top + size[1], left : left + size[0]] = cv2.resize(patch, size, interpolation=cv2.INTER_AREA)
    return cell


def _paint_depth(depth: NDArray) -> Picture:
    """Near is warm, far is cold, no depth is black."""
    known = depth > 0
    if not known.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[known], DEPTH_STRETCH)
    share = np.clip((depth - low) / max(high - low, 1.0), 0.0, 1.0)
    bgr = cv2.applyColorMap((255 * (1.0 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)
    painted = np.ascontiguousarray(bgr[:, :, ::-1], np.uint8)
    painted[~known] = 0
    return painted


def _paint_regions(region: NDArray) -> Picture:
    further = np.resize(MORE_COLORS, (256 - len(REGION_COLORS), 3))
    painted: Picture = np.concatenate([REGION_COLORS, further])[region]
    return painted


def main() -> None:
    """Draw what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m services.read.contact_sheet", description=__doc__.splitlines()[0])
    parser.add_argument("out", metavar="OUT", help="a dataset's folder")
    parser.add_argument("file", metavar="FILE.jpg", type=Path, help="the picture to write")
    parser.add_argument("scenes", metavar="SCENES", type=int, nargs="?", default=1, help="scenes of each category")
    parser.add_argument("category", metavar="CATEGORY", nargs="?", help="only this one")
    options = parser.parse_args()
    sheet = draw_sheet(open_store(options.out), options.scenes, options.category)
    Image.fromarray(sheet).save(options.file, quality=88)


if __name__ == "__main__":
    main()

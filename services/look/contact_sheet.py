"""Every target of a scene in one picture: `python -m services.look.contact_sheet OUT SCENE FILE.png [input|mirror]`."""

import io
import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from schemas.base import Pose
from schemas.dataset.codec import read_camera
from schemas.errors import InputError
from services.look.charts import Histogram
from services.look.clouds import Cloud, read_samples
from services.look.pictures import DEPTH_M, FIXED_REGIONS, PATCH, SHOWN_ROLES, show_scene
from services.read.dataset_reader import file_reader, find_scene
from workers.store.local import open_store
from workers.store.store import Store

WIDTH, COLUMNS, GAP, LINE = 1600, 5, 10, 22
"""Of the sheet, pixels: its width, the space between pictures, and the height of a caption."""

MOST_SAMPLES = 300_000
"""Samples of each kind that are drawn."""

SLICE_SHARE = 0.04
"""Half the thickness of the slice of the volume that is drawn, of the extent of its samples along the optical axis."""


def draw_contact_sheet(store: Store, scene_id: int, role: str = "input") -> Image.Image:
    """The patches of one view about the scene's first object, and samples of its objects, each with its name.

    In place of patches the images of the whole view where it has none. Raises InputError for a scene that was not made.
    """
    stored = find_scene(store, scene_id)
    scene = stored.scene(scene_id)
    if scene is None:
        raise InputError(f"scene {scene_id} failed: choose another")
    shown = show_scene(
        file_reader(store.read, stored), stored, scene, {role: Histogram(*DEPTH_M) for role in SHOWN_ROLES}
    )
    of_view = [name for name in shown.pictures if name.startswith(f"{role} ")]
    tiles = [shown.pictures[name] for name in [name for name in of_view if name.endswith(PATCH)] or of_view]
    pictures = [
        (one.caption.removeprefix(f"{role} · "), Image.open(io.BytesIO(one.data)).convert("RGB")) for one in tiles
    ]
    clouds = {cloud.role: cloud for cloud in read_samples(store, scene, MOST_SAMPLES)}
    view, size = next(stored.pairs(scene_id))[0][role], pictures[0][1].size
    size = (_width(), round(size[1] * _width() / size[0]))
    T = read_camera(view).T_world_cam
    if "surface" in clouds:
        pictures.append(("surface samples", Image.fromarray(draw_points([clouds["surface"]], T, size))))
    if "inside" in clouds:
        slices = [clouds["inside"], clouds["outside"]]
        pictures.append(("volume samples, a slice", Image.fromarray(draw_points(slices, T, size, SLICE_SHARE))))
    return _lay_out(pictures, size)


def _width() -> int:
    return (WIDTH - (COLUMNS + 1) * GAP) // COLUMNS


def draw_points(
    clouds: Sequence[Cloud], T_world_cam: Pose, size: tuple[int, int], slice_share: float | None = None
) -> NDArray[np.uint8]:
    """[H, W, 3]: points seen along the camera's optical axis without perspective, near ones over far ones.

    `slice_share`: only those that lie within this share of their extent of the middle along the axis.
    """
    points = np.concatenate([cloud.points for cloud in clouds]) @ T_world_cam[:3, :3]
    colors = np.concatenate([cloud.colors for cloud in clouds])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = (low + high) / 2.0, high - low
    kept = np.argsort(-points[:, 2])
    if slice_share is not None:
        kept = kept[np.abs(points[kept, 2] - middle[2]) < slice_share * extent[2]]
    width, height = size
    pixels = (points[kept, :2] - middle[:2]) * 0.92 * min(width / extent[0], height / extent[1]) + [
        width / 2,
        height / 2,
    ]
    columns, rows = np.floor(pixels).astype(np.int64).T
    image = np.full((height, width, 3), FIXED_REGIONS[0], np.uint8)
    for one in ((0, 0), (0, 1), (1, 0), (1, 1)):
        image[rows + one[0], columns + one[1]] = colors[kept]
    return image


def _lay_out(pictures: Sequence[tuple[str, Image.Image]], size: tuple[int, int]) -> Image.Image:
    """The pictures in rows, each at this size, with its words below it."""
    width, step = size[0] + GAP, size[1] + LINE + GAP
    rows = -(-len(pictures) // COLUMNS)
    sheet = Image.new("RGB", (WIDTH, GAP + rows * step), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for at, (words, picture) in enumerate(pictures):
        left, top = GAP + at % COLUMNS * width, GAP + at // COLUMNS * step
        sheet.paste(picture.resize(size, Image.Resampling.NEAREST), (left, top))
        pen.text((left, top + size[1] + 2), words, "black", font)
    return sheet


if __name__ == "__main__":
    out, scene_id, file, *role = sys.argv[1:]
    draw_contact_sheet(open_store(out), int(scene_id), *role).save(file, optimize=True)

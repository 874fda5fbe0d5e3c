"""Edge: one page with a picture of every object as it will stand on the table, and what is known of it."""

import math
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.base import frozen_array
from schemas.job.render import Render
from schemas.scene.camera import Camera, Intrinsics
from schemas.scene.effects import EffectPlan
from schemas.scene.region import REGION_FIRST_OBJECT, REGION_FLOOR
from schemas.scene.scene import Placed
from schemas.scene.shape import Asset, Material, Part, Shape
from services.init.table import shorten
from workers.assets.appearance.draw import draw_appearance
from workers.assets.external.mesh import transform_shape
from workers.geometry.frames import pose, translation
from workers.render.raster.gbuffer import Renderer

MOST = 60
"""Pictures on a page."""

COLUMNS, TILE = 5, (300, 260)
LINE, LINES, MARGIN = 17, 5, 10
FONT = 13

SIZE_M = 0.25
"""Diagonal at which every object is drawn: the text has its size."""

YAW_RAD, PITCH_RAD, DISTANCE_M = 0.6, 0.5, 0.62
EFFECTS = EffectPlan(
    ("rgb", "floor", "textures", "shadows", "ambient_occlusion", "antialiasing", "transparency", "light_maps"), {}
)
WARNING = "#b03000"


@dataclass(frozen=True)
class Tile:
    """An object on the page: how it is loaded, its caption, and the lines that ask for attention."""

    load: Callable[[], Asset]
    caption: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def draw_sheet(title: str, tiles: Sequence[Tile], notes: Sequence[str], renderer: Renderer) -> Image.Image:
    """The page: a title, up to `MOST` objects, and notes below them."""
    shown = tiles[:MOST]
    if len(tiles) > MOST:
        notes = [f"and {len(tiles) - MOST} objects more, which are not drawn", *notes]
    columns = min(COLUMNS, max(len(shown), 3))
    cell = (TILE[0] + MARGIN, TILE[1] + LINE * LINES + 2 * MARGIN)
    rows = math.ceil(len(shown) / columns)
    top = 2 * LINE + MARGIN
    page = Image.new("RGB", (columns * cell[0] + MARGIN, top + rows * cell[1] + LINE * len(notes) + MARGIN), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(FONT)
    fit = columns * cell[0] // 7
    pen.text((MARGIN, MARGIN), shorten(title, fit), "black", ImageFont.load_default(FONT + 3))
    for number, tile in enumerate(shown):
        left, upper = MARGIN + number % columns * cell[0], top + number // columns * cell[1]
        page.paste(draw_object(tile.load(), renderer), (left, upper))
        lines = [(line, "black") for line in tile.caption] + [(line, WARNING) for line in tile.warnings]
        for row, (line, colour) in enumerate(lines[:LINES]):
            pen.text((left, upper + TILE[1] + 3 + row * LINE), _fit(line, font, TILE[0]), colour, font)
    for row, note in enumerate(notes):
        pen.text((MARGIN, top + rows * cell[1] + row * LINE), _fit(note, font, page.width - 2 * MARGIN), "black", font)
    return page


def draw_object(asset: Asset, renderer: Renderer) -> Image.Image:
    """The asset on the ground, seen from a little above, with its z up."""
    lower, upper = asset.shape.bounds
    scale = SIZE_M / float(np.linalg.norm(upper - lower))
    shape = transform_shape(asset.shape, pose(scale * np.eye(3), np.zeros(3)))
    height = scale * float(upper[2] - lower[2])
    things = [Placed(REGION_FLOOR, _ground(), np.eye(4))]
    things.append(Placed(REGION_FIRST_OBJECT, shape, translation(0.0, 0.0, -scale * float(lower[2]))))
    _, light = draw_appearance(np.random.default_rng(4), "flat")
    seen = renderer.draw(things, light, _camera(0.5 * height), Render(tier="raster"), EFFECTS)
    assert seen.rgb is not None
    return Image.fromarray(seen.rgb)


def _camera(middle_m: float) -> Camera:
    """Looks at the middle of the object, in the optical frame."""
    width, height = TILE
    level = math.cos(PITCH_RAD)
    back = np.array([-level * math.sin(YAW_RAD), -level * math.cos(YAW_RAD), math.sin(PITCH_RAD)])
    right = np.array([math.cos(YAW_RAD), -math.sin(YAW_RAD), 0.0])
    rotation = np.stack([right, np.cross(-back, right), -back], axis=1)
    focal = 0.9 * height * DISTANCE_M / SIZE_M
    intrinsics = Intrinsics(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
    return Camera(intrinsics, pose(rotation, np.array([0.0, 0.0, middle_m]) + DISTANCE_M * back))


def _ground() -> Shape:
    corners = 5.0 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    faces = frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Shape((Part("ground", frozen_array(corners), faces, Material((0.75, 0.75, 0.74, 1.0), roughness=0.9)),))


def _fit(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int) -> str:
    """The text in the letters that the font has, cut in its middle where it is wider than `width` pixels."""
    text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    most = len(text)
    while most > 4 and font.getlength(shorten(text, most)) > width:
        most -= 1
    return shorten(text, most)

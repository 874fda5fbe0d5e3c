"""Edge: what was read of a folder, as a table for a terminal and as a page of pictures."""

import math
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.base import frozen_array
from schemas.job.assets import FolderSource
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, Asset, Material, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from services.init.collection import PART, Item, LeftOut
from workers.assets.appearance import draw_appearance
from workers.assets.catalogue import AnySource, Catalogue, InstanceRef
from workers.assets.external.mesh import transform_shape
from workers.geometry.frames import pose, translation
from workers.render.raster.gbuffer import Renderer

MOST_ROWS = 40
"""Rows that a terminal shows; `--json` has all."""

HEADINGS = ("file", "category", "size, cm", "faces", "closed", "pictures", "up", "notes")
LEAST = (12, 8, 19, 5, 6, 6, 4, 5)
"""Widths to which columns may shrink."""


def draw_table(rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Lines of at most `width` characters; a cell that does not fit is cut in its middle, where … stands."""
    shown = [HEADINGS, *rows[:MOST_ROWS]]
    widths = [max(len(row[column]) for row in shown) for column in range(len(HEADINGS))]
    least = [min(wanted, low) for wanted, low in zip(widths, LEAST, strict=True)]
    while sum(widths) + 2 * (len(widths) - 1) > width and widths != least:
        widest = max((k for k in range(len(widths)) if widths[k] > least[k]), key=lambda k: widths[k])
        widths[widest] -= 1
    cells = [[shorten(cell, most).ljust(most) for cell, most in zip(row, widths, strict=True)] for row in shown]
    lines = [shorten("  ".join(row).rstrip(), width) for row in cells]
    if len(rows) > MOST_ROWS:
        lines.append(f"and {len(rows) - MOST_ROWS} more: --json lists all")
    return lines


def draw_left_out(left_out: Sequence[LeftOut], width: int) -> list[str]:
    """A line for each file that is not used, and how many there are; the parts of URDFs are counted."""
    if not left_out:
        return []
    told = [one for one in left_out if one.reason != PART]
    lines = [f"left out: {len(told)} file{'s' * (len(told) != 1)}"] if told else []
    lines += [shorten(f"  {one.path} ({one.reason}): {one.why}", width) for one in told[:MOST_ROWS]]
    if len(told) > MOST_ROWS:
        lines.append(f"  and {len(told) - MOST_ROWS} more: --json lists all")
    if parts := len(left_out) - len(told):
        lines.append(f"{parts} mesh{'es' * (parts != 1)} not offered by themselves: parts of the URDFs")
    return lines


def shorten(text: str, most: int) -> str:
    """The text with … in its middle where it is longer than `most`."""
    if len(text) <= most:
        return text
    head = max(1, (most - 1) // 2)
    return f"{text[:head]}…{text[len(text) - (most - 1 - head) :]}"


@dataclass(frozen=True)
class Shown:
    """A file as the table, the pictures and `--json` have it. size_m: width, depth and height as it will stand.

    missing_textures: pictures or material files that are missing or cannot be read, by the notes on the file; up: the axis
    that the job has up; shape_says, confidence: what the shape tells about it.
    """

    path: str
    category: str
    size_m: tuple[float, float, float]
    vertices: int
    faces: int
    watertight: bool
    textures: int
    missing_textures: int
    up: str
    shape_says: str | None
    confidence: str | None
    notes: tuple[str, ...]

    @property
    def told(self) -> tuple[str, str, str, str]:
        """Size as width x depth x height in centimetres; whether it is closed; pictures found, of how many; up, as judged."""
        size = " x ".join(f"{100 * extent:.3g}" for extent in self.size_m)
        pictures = f"{self.textures}" + (
            f" of {self.textures + self.missing_textures}" if self.missing_textures else ""
        )
        if self.shape_says is None:
            up = f"{self.up}?"
        else:
            up = f"{self.up} {self.confidence}" if self.shape_says == self.up else f"{self.up} (or {self.shape_says})"
        return size, "yes" if self.watertight else "no", pictures, up

    @property
    def row(self) -> tuple[str, ...]:
        """Its line of the table."""
        size, closed, pictures, up = self.told
        return self.path, self.category, size, str(self.faces), closed, pictures, up, "; ".join(self.notes)

    @property
    def caption(self) -> tuple[str, ...]:
        """Its lines below the picture."""
        size, _, pictures, up = self.told
        closed = "closed" if self.watertight else "not closed"
        return (
            self.path,
            f"{self.category}, {size} cm, up: {up}",
            f"{self.faces} faces, {closed}, pictures: {pictures}",
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """The lines that ask for attention."""
        if self.shape_says is None:
            return "which way is up is not known", *self.notes
        doubt = f"by its shape {self.shape_says} is up ({self.confidence})"
        return (doubt,) * (self.shape_says != self.up) + self.notes


def show_items(catalogue: Catalogue, items: Sequence[Item]) -> list[tuple[Shown, InstanceRef]]:
    """The items as the job's catalogue has them, and how each is loaded."""
    refs = {
        entry.files[0].path: catalogue.refer(source, category, index)
        for source, listing in enumerate(catalogue.objects)
        for category, entries in (listing.entries.items() if listing is not None else ())
        for index, entry in enumerate(entries)
    }
    return [(_show(item, catalogue.settings(refs[item.path])), refs[item.path]) for item in items]


def _show(item: Item, settings: AnySource) -> Shown:
    measured = item.measured
    assert isinstance(settings, FolderSource)
    up = settings.up_of(item.path)
    scale = settings.scale if settings.diagonal_m is None else settings.diagonal_m / item.diagonal
    x, y, z = (scale * extent for extent in measured.extents)
    return Shown(
        path=item.path,
        category=item.category,
        size_m={"x": (z, y, x), "y": (x, z, y), "z": (x, y, z)}[up],
        vertices=measured.vertices,
        faces=measured.faces,
        watertight=measured.watertight,
        textures=measured.textures,
        missing_textures=sum(note.endswith("plain base colour used") for note in measured.notes),
        up=up,
        shape_says=measured.up,
        confidence=measured.confidence,
        notes=measured.notes,
    )


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


def draw_sheet(
    title: str, objects: Sequence[tuple[Shown, Callable[[], Asset]]], notes: Sequence[str], renderer: Renderer
) -> Image.Image:
    """The page: a title, up to `MOST` objects, each loaded when it is drawn, and notes below them."""
    drawn = objects[:MOST]
    if len(objects) > MOST:
        notes = [f"and {len(objects) - MOST} objects more, which are not drawn", *notes]
    columns = min(COLUMNS, max(len(drawn), 3))
    cell = (TILE[0] + MARGIN, TILE[1] + LINE * LINES + 2 * MARGIN)
    rows = math.ceil(len(drawn) / columns)
    top = 2 * LINE + MARGIN
    page = Image.new("RGB", (columns * cell[0] + MARGIN, top + rows * cell[1] + LINE * len(notes) + MARGIN), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(FONT)
    fit = columns * cell[0] // 7
    pen.text((MARGIN, MARGIN), shorten(title, fit), "black", ImageFont.load_default(FONT + 3))
    for number, (one, load) in enumerate(drawn):
        left, upper = MARGIN + number % columns * cell[0], top + number // columns * cell[1]
        page.paste(draw_object(load(), renderer), (left, upper))
        lines = [(line, "black") for line in one.caption] + [(line, WARNING) for line in one.warnings]
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

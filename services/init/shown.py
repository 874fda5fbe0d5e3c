"""Edge: what was read of a folder, as a table for a terminal and as a page of pictures."""

import math
import unicodedata
from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import zip_longest
from pathlib import PurePosixPath

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.base import frozen_array
from schemas.errors import plural
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, Asset, Material, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from workers.assets.library.guess import METRIC, ON_TABLE_M, length
from workers.assets.library.table import Row
from workers.assets.look.appearance import draw_appearance
from workers.door.meshes.mesh import transform_shape
from workers.geometry.frames import pose, translation
from workers.render.raster.gbuffer import Renderer

MOST_ROWS = 40
"""Rows that a terminal shows; a pipe and `--json` have all."""

HEADINGS = ("file", "category", "size, cm", "faces", "closed", "pictures", "up", "notes")
LEAST = 5
"""Width to which a column may shrink."""

BREAKS = " /;,_-"
"""Letters after which a line is rather broken than within a word."""


def draw_table(rows: Sequence[Sequence[str]], width: int | None) -> list[str]:
    """Lines of at most `width` characters, None: of any; what does not fit goes on below, in the same column."""
    shown = [HEADINGS, *(rows if width is None else rows[:MOST_ROWS])]
    widths = [max(len(row[column]) for row in shown) for column in range(len(HEADINGS))]
    while width is not None and sum(widths) + 2 * (len(widths) - 1) > width and max(widths) > LEAST:
        widths[widths.index(max(widths))] -= 1
    lines = []
    for row in shown:
        cells = [fold(cell, most) for cell, most in zip(row, widths, strict=True)]
        for parts in zip_longest(*cells, fillvalue=""):
            lines.append("  ".join(part.ljust(most) for part, most in zip(parts, widths, strict=True)).rstrip())
    if len(shown) - 1 < len(rows):
        lines.append(f"and {len(rows) - MOST_ROWS} more: --json lists all")
    return lines


def draw_left_out(left_out: Sequence[Row], width: int | None) -> list[str]:
    """A line for each reason why files are not used, with the first of them, and how many there are."""
    if not left_out:
        return []
    by_reason: dict[tuple[str, str], list[str]] = {}
    for row in left_out:
        by_reason.setdefault((row.reason, row.why), []).append(row.path)
    reasons = list(by_reason.items())
    shown = reasons if width is None else reasons[:MOST_ROWS]
    lines = [f"left out: {plural(len(left_out), 'file')}"]
    for (reason, why), paths in shown:
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        first, *rest = fold(f"{paths[0]}{more} ({reason}): {why}", width and width - 4)
        lines += [f"  {first}", *(f"    {line}" for line in rest)]
    hidden = sum(len(paths) for _, paths in reasons[len(shown) :])
    return [*lines, f"  and {hidden} more: --json lists all"] if hidden else lines


def fold(text: str, most: float | None, measure: Callable[[str], float] = len) -> list[str]:
    """The text in lines of at most `most`, nothing left out; at least one."""
    lines = []
    while most is not None and text and measure(text) > most:
        count = bisect_right(range(1, len(text)), most, key=lambda n: measure(text[:n])) or 1
        cut = max(text.rfind(letter, 1, count) for letter in BREAKS) + 1 or count
        lines.append(text[:cut].rstrip())
        text = text[cut:].lstrip(" ")
    return [*lines, text] if text or not lines else lines


def describe_row(row: Row) -> tuple[str, str, str, str]:
    """Size as width x depth x height in centimetres; whether it is closed; pictures, of how many; up, as judged."""
    size = "?" if row.extents_m is None else " x ".join(f"{100 * extent:.3g}" for extent in row.extents_m)
    missing = sum(note.endswith("plain base colour used") for note in row.mended)
    pictures = "?" if row.pictures is None else f"{row.pictures}" + (f" of {row.pictures + missing}" if missing else "")
    if row.shape_up is None:
        up = f"{row.up}?"
    else:
        up = (
            f"{row.up} {'sure' if row.sure else 'likely'}"
            if row.shape_up == row.up
            else f"{row.up} (or {row.shape_up})"
        )
    return size, "?" if row.watertight is None else "yes" if row.watertight else "no", pictures, up


def cells_of(row: Row) -> tuple[str, ...]:
    """Its line of the table."""
    size, closed, pictures, up = describe_row(row)
    return row.path, row.category, size, str(row.faces or "?"), closed, pictures, up, "; ".join(notes_of(row))


def notes_of(row: Row) -> tuple[str, ...]:
    """What asks for attention."""
    if row.extents_m is None:
        return row.mended
    size, mended = math.hypot(*row.extents_m), row.mended
    if PurePosixPath(row.path).suffix.lower() in METRIC and row.unit in (0.01, 0.001):
        mended = (f"a unit is taken for {length(row.unit)}, where the format says 1 m: see `unit`", *mended)
    if ON_TABLE_M[0] <= size <= ON_TABLE_M[1]:
        return mended
    how = "small" if size < ON_TABLE_M[0] else "large"
    return f"{length(size)} across, {how} for a table: see `unit`", *mended


MOST = 60
"""Pictures on a page."""

COLUMNS, TILE = 5, (300, 260)
LINE, MARGIN = 17, 10
FONT = 13

SIZE_M = 0.25
"""Diagonal at which every object is drawn: the text has its size."""

YAW_RAD, PITCH_RAD, DISTANCE_M = 0.6, 0.5, 0.62
EFFECTS = EffectPlan(
    ("rgb", "floor", "textures", "shadows", "ambient_occlusion", "antialiasing", "transparency", "light_maps"), {}
)
WARNING = "#b03000"


def draw_sheet(
    title: str, objects: Sequence[tuple[Row, Callable[[], Asset]]], notes: Sequence[str], renderer: Renderer
) -> Image.Image:
    """The page: a title, up to `MOST` objects, each loaded when it is drawn, and notes below them."""
    drawn = objects[:MOST]
    if len(objects) > MOST:
        notes = [f"and {plural(len(objects) - MOST, 'object')} more, which are not drawn", *notes]
    columns = min(COLUMNS, max(len(drawn), 3))
    step, font, large = TILE[0] + MARGIN, ImageFont.load_default(FONT), ImageFont.load_default(FONT + 3)
    inside = columns * step - MARGIN
    head = [(line, "black", large) for line in fold(_letters(title), inside, large.getlength)]
    foot = [(line, "black", font) for note in notes for line in fold(_letters(note), inside, font.getlength)]
    captions = [_caption(row, font) for row, _ in drawn]
    rows = [range(k, min(k + columns, len(drawn))) for k in range(0, len(drawn), columns)]
    heights = [TILE[1] + LINE * max(len(captions[k]) for k in row) + 2 * MARGIN for row in rows]
    page = Image.new(
        "RGB", (inside + 2 * MARGIN, LINE * (len(head) + len(foot) + 1) + sum(heights) + 2 * MARGIN), "white"
    )
    pen, top = ImageDraw.Draw(page), MARGIN
    top = _write_lines(pen, (MARGIN, top), head) + MARGIN
    for row, height in zip(rows, heights, strict=True):
        for column, k in enumerate(row):
            page.paste(draw_object(drawn[k][1](), renderer), (MARGIN + column * step, top))
            _write_lines(pen, (MARGIN + column * step, top + TILE[1] + 3), captions[k])
        top += height
    _write_lines(pen, (MARGIN, top), foot)
    return page


Line = tuple[str, str, ImageFont.FreeTypeFont | ImageFont.ImageFont]
"""Text, colour and font."""


def _caption(row: Row, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> list[Line]:
    """Its lines below the picture, and those that ask for attention."""
    size, _, pictures, up = describe_row(row)
    closed = "closed" if row.watertight else "not closed"
    lines = [row.path, f"{row.category}, {size} cm, up: {up}", f"{row.faces} faces, {closed}, pictures: {pictures}"]
    warnings = [*notes_of(row)]
    if row.shape_up is None:
        warnings.insert(0, "which way is up is not known")
    elif row.shape_up != row.up:
        warnings.insert(0, f"by its shape {row.shape_up} is up ({'sure' if row.sure else 'likely'})")
    texts = [(text, "black") for text in lines] + [(text, WARNING) for text in warnings]
    return [(line, colour, font) for text, colour in texts for line in fold(_letters(text), TILE[0], font.getlength)]


def _write_lines(pen: ImageDraw.ImageDraw, at: tuple[int, int], lines: Sequence[Line]) -> int:
    """Writes lines one below the other; where the next one would be."""
    left, top = at
    for text, colour, font in lines:
        pen.text((left, top), text, colour, font)
        top += LINE
    return top


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


def _letters(text: str) -> str:
    """The text in the letters that the font has: without accents, and of other scripts the numbers of their letters."""
    plain = "".join(c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return plain.encode("ascii", "backslashreplace").decode()

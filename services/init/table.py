"""Pure: what was read of a folder, as a table that fits a terminal, and what was left out."""

from collections.abc import Sequence

from services.init.model import LeftOut

PART = "part"
"""The reason why a mesh that a URDF names is not an object by itself."""

MOST_ROWS = 40
"""Rows that a terminal shows; `--json` has all."""

HEADINGS = ("file", "category", "size, cm", "faces", "closed", "pictures", "up", "notes")
LEAST = (12, 8, 19, 5, 6, 6, 4, 5)
"""Widths to which columns may shrink."""


def describe_size(extents_m: Sequence[float]) -> str:
    """Width x depth x height as it will stand, centimetres."""
    return " x ".join(f"{100 * extent:.3g}" for extent in extents_m)


def missing_pictures(notes: Sequence[str]) -> int:
    """Pictures or material files that are missing or cannot be read, by the notes on a file."""
    return sum(note.endswith("plain base colour used") for note in notes)


def describe_up(axis: str, shape_says: str | None, confidence: str | None) -> str:
    """The axis that the job has up, and what the shape says to it."""
    if shape_says is None:
        return f"{axis}?"
    return f"{axis} {confidence}" if shape_says == axis else f"{axis} (or {shape_says})"


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

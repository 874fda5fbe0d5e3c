"""`verso init`: a commented job file for a folder of meshes, with a page of pictures of what was read."""

import argparse
import io
import json
import os
import re
import shutil
import sys
from collections import Counter
from dataclasses import asdict
from functools import partial
from pathlib import Path

from schemas.errors import AssetSourceError, InputError, MachineError, OutputError
from schemas.job.job import Job
from schemas.plain_line import plain_line
from services.init.categories import BY_FILE, BY_FOLDER, category_of, is_category, map_categories
from services.init.guess import guess_scales, guess_ups
from services.init.job_text import write_job
from services.init.model import Candidate, Guess, Item, LeftOut, Reading
from services.init.read import LARGEST, SMALLEST, read_folder
from services.init.sheet import Tile, draw_sheet
from services.init.shown import Shown, show_items
from services.init.table import draw_left_out, draw_table
from services.init.walk import walk_folder
from services.job.bounded_yaml import parse_yaml
from services.job.job_file import MOST_BYTES, MOST_KEYS, validate_job
from services.run.progress import ProgressLine
from workers.assets.catalogue import Catalogue, InstanceRef, open_catalogue
from workers.render.raster.gbuffer import shared_renderer

SHEET_WIDTH = 200
"""Letters in a line below the pictures."""

MOST_NAMED = 5
"""Files with another axis than their neighbours that are named; the job has them all."""

MOST_UPS = 2
"""Levels by which the job file may lie beside the folder for the folder to be named from it."""


def main(options: argparse.Namespace) -> int:
    """`verso init`."""
    folder: Path = options.folder
    by = options.category_from
    if by not in (None, BY_FOLDER, BY_FILE) and not is_category(by):
        raise InputError(f"--category-from {plain_line(by)}: write folder, file, or a name of letters, digits, - and _")
    out: Path = options.out or Path(f"{dataset_name(folder)}.yaml")
    sheet: Path = options.sheet or out.with_suffix(".jpg")
    _check_targets(out, sheet)
    walk = walk_folder(folder)
    reading = _read(folder.resolve(), [Candidate(path, category_of(path, by)) for path in walk.paths])
    guess, items, wrong_size = make_guess(reading)
    left_out = sorted((*walk.left_out, *reading.left_out, *wrong_size), key=lambda one: one.path)
    width = shutil.get_terminal_size((100, 24)).columns
    if not items:
        print("\n".join(draw_left_out(left_out, width)), file=sys.stderr)
        raise AssetSourceError(f"{plain_line(str(folder), 300)}: none of its {len(left_out)} meshes can be used")
    text = _job_text(folder, out, sheet, items, guess)
    job = check_text(text)
    catalogue = open_catalogue(job.assets, out.parent, tuple(job.categories))
    shown = show_items(catalogue, items)
    print("\n".join([*draw_table([one.row for one, _ in shown], width), *draw_left_out(left_out, width)]))
    tiles = [_tile(catalogue, one, ref) for one, ref in shown]
    drawn = _draw(sheet, options.sheet is not None, f"{folder}: {len(items)} objects", tiles, left_out)
    _write(out, text.encode(), "--out")
    print(f"{out}: {len(items)} objects in {len(job.categories)} categories")
    print("\n".join(f"  {line}" for line in describe_guess(guess)))
    print(
        f"  look at {sheet}, and change in {out} what is wrong; then" if drawn else "then",
        f"verso run {out} --scenes 8",
    )
    told = {"job": str(out), "sheet": str(sheet) if drawn else None, "categories": list(job.categories)}
    objects = [asdict(one) for one, _ in shown]
    if options.json:
        print(json.dumps({"ok": True, **told, "objects": objects, "left_out": [asdict(one) for one in left_out]}))
    return 0


def describe_guess(guess: Guess) -> list[str]:
    """A line for each unit and each axis that was guessed."""
    ups = [f"up: {rule.axis} in {rule.pattern}: {rule.why}" for rule in guess.ups if rule.pattern.startswith("**/")]
    others = [f"{rule.pattern} {rule.axis}" for rule in guess.ups if not rule.pattern.startswith("**/")]
    more = f" and {len(others) - MOST_NAMED} more" if len(others) > MOST_NAMED else ""
    told = [f"up differs: {', '.join(others[:MOST_NAMED])}{more}: stands on this axis alone"] if others else []
    return [scale.why for scale in guess.scales] + ups + told


def _check_targets(out: Path, sheet: Path) -> None:
    if sheet.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        raise InputError(f"--sheet {sheet}: must end in .jpg or .png")
    for path, asked in ((out, "--out"), (sheet, "--sheet")):
        if path.exists():
            raise OutputError(f"{path} is there already: remove it, or choose another {asked}")


def dataset_name(folder: Path) -> str:
    """A name for the job, after the folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", folder.resolve().name).strip("-._")[:64] or "meshes"


def make_guess(reading: Reading) -> tuple[Guess, list[Item], list[LeftOut]]:
    """What the job says, the files that it uses, and those whose size at that scale is none of a thing on a table."""
    scales, items, left_out = guess_scales(reading.items), [], []
    for item in reading.items:
        (scale,) = (scale for scale in scales if item.suffix in scale.suffixes)
        size = scale.diagonal_m or item.diagonal * scale.factor
        if SMALLEST <= size <= LARGEST:
            items.append(item)
        else:
            why = f"would be {size:.3g} m across at scale {scale.factor:g}: put it into a folder of its own, and init that"
            left_out.append(LeftOut(item.path, "size", why))
    others = {one.path for one in (*reading.left_out, *left_out)}
    harmless = {*reading.refused, *(one.path for one in left_out)}
    found = {item.path: item.category for item in items}
    patterns = map_categories(found, others, harmless)
    used = {item.suffix for item in items}
    kept = tuple(scale for scale in scales if used & set(scale.suffixes))
    return Guess(kept, tuple(guess_ups(items)), patterns), items, left_out


def check_text(text: str) -> Job:
    """The job of the text. InputError where it is longer than a job file may be."""
    if len(text.encode()) > MOST_BYTES:
        raise InputError(
            f"the job would have {len(text.encode())} bytes, because the files of a category do not lie together: put each "
            "category into a folder of its own, or name one with --category-from NAME"
        )
    return validate_job(parse_yaml(text, MOST_KEYS), "the new job")


def _read(folder: Path, candidates: list[Candidate]) -> Reading:
    lines = dict[str, ProgressLine]()

    def watch(what: str, done: int, asked: int) -> None:
        lines.setdefault(what, ProgressLine(asked, what, "file")).show(done)

    try:
        return read_folder(folder, candidates, watch)
    finally:
        for line in lines.values():
            line.close()


def _job_text(folder: Path, out: Path, sheet: Path, items: list[Item], guess: Guess) -> str:
    near = os.path.relpath(folder.resolve(), out.parent.resolve())
    named = str(folder.resolve()) if near.split("/")[: MOST_UPS + 1] == [".."] * (MOST_UPS + 1) else near
    counts, suffixes = Counter(item.category for item in items), Counter(item.suffix for item in items)
    return write_job(dataset_name(folder), str(out), named, sheet.name, counts, suffixes, guess)


def _draw(sheet: Path, asked: bool, title: str, tiles: list[Tile], left_out: list[LeftOut]) -> bool:
    """Writes the pictures; whether it could. MachineError where they were asked for by name and cannot be drawn."""
    try:
        page = draw_sheet(title, tiles, draw_left_out(left_out, SHEET_WIDTH), shared_renderer())
    except MachineError as error:
        if asked:
            raise
        print(f"verso: no pictures: {error}", file=sys.stderr)
        return False
    data = io.BytesIO()
    page.save(data, "PNG" if sheet.suffix.lower() == ".png" else "JPEG", quality=88)
    _write(sheet, data.getvalue(), "--sheet")
    return True


def _tile(catalogue: Catalogue, shown: Shown, ref: InstanceRef) -> Tile:
    """The picture of a file, with what asks for attention."""
    other = shown.shape_says not in (None, shown.up)
    doubt = f"by its shape {shown.shape_says} is up ({shown.confidence})" if other else "which way is up is not known"
    warnings = (doubt,) * (other or shown.shape_says is None) + shown.notes
    return Tile(partial(catalogue.load, ref), shown.caption, warnings)


def _write(path: Path, data: bytes, option: str) -> None:
    """Writes a new file. OutputError where it cannot be written, or is there by now."""
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True)
        with path.open("xb") as file:
            file.write(data)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}; choose another {option}") from error

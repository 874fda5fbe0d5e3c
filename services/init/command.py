"""`verso init`: a commented job file for a folder of meshes, with a page of pictures of what was read."""

import argparse
import io
import json
import os
import re
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from schemas.errors import AssetSourceError, InputError, MachineError, OutputError, plain_line
from schemas.job.assets import matches
from schemas.job.job import Job
from schemas.scene.shape import Asset
from services.init.categories import BY_FILE, BY_FOLDER, BY_PARENT, is_category, map_categories, name_categories
from services.init.collection import SUFFIXES, read_folder, walk_folder
from services.init.copies import COPY, PART, Item, LeftOut, Reading, find_doubles
from services.init.guess import Group, Guess, guess_groups, guess_ups, length, plain_axis
from services.init.shown import Shown, draw_left_out, draw_sheet, draw_table, plural, show_items
from services.job.bounded_yaml import parse_yaml
from services.job.job_file import MOST_BYTES, MOST_KEYS, validate_job
from services.run.progress import ProgressLine
from workers.assets.catalogue import open_catalogue
from workers.render.raster.gbuffer import shared_renderer

SCENES = 64

HEAD = """\
# A dataset of your own meshes: {objects} in {categories}, from {folder}
# Written by `verso init`. What it guessed is said beside each key: look at the pictures{sheet}, and change what is wrong.
#
#   ./verso run {job} --scenes 8        a first look, then
#   ./verso run {job} --scenes 10000    goes on from there
#
# Every key that is not here has the default that docs/job.md tells.

verso: 1
name: {name}

# Everything that is drawn follows from this number and a scene's id.
seed: 1
scenes: {scenes}

# How often each is drawn: equal weights. A weight of 2 makes a category twice as frequent.
categories:
{weights}

assets:
  objects:
{sources}
  # What they stand on: tables made from a seed.
  tables:
    - source: procedural

start:
  # upright: as it stands in the pictures, at any yaw; tumbled: dropped in any rotation.
  pose: upright
"""

SOURCE = """\
    - source: files # a folder of meshes, and of what poses them
      folder: {folder}
      weight: {weight} # its number of files

{scale_why}
      # Objects keep their own size; in place of that, `diagonal_m: 0.25` makes each as large as the article's objects are,
      # for which the cameras stand where they do. Or move them: cameras.orbit.radius_m and cameras.mirror.T_z_m.
{scale}

      # Which axis of the files points up.
{up}

      # Category by file pattern; the first match wins. Rename them as you like, and the keys of `categories` with them.
      category_map:
{category_map}

      # State the licence of the shapes; with `copy_assets: true` the dataset holds the shapes too.
      licence: unknown
      copy_assets: false
"""


def write_job(name: str, job: str, folder: str, sheet: str | None, categories: Mapping[str, str], guess: Guess) -> str:
    """The text of the job file.

    name: of the dataset; job: what the file will be called; folder: as the job file names it; categories: by path.
    """
    counts = Counter(categories.values())
    return HEAD.format(
        objects=plural(counts.total(), "object"),
        categories=plural(len(counts), "category"),
        folder=_comment(folder),
        sheet=f" ({_comment(sheet)})" if sheet else "",
        job=_comment(job),
        name=name,
        scenes=SCENES,
        weights="\n".join(
            f"  {_quoted(category)}: 1 # {plural(count, 'file')}" for category, count in sorted(counts.items())
        ),
        sources="\n".join(_source(folder, group, guess) for group in guess.groups),
    )


def _source(folder: str, group: Group, guess: Guess) -> str:
    """The source of the files of one scale."""
    rules = [rule for rule in guess.ups if any(matches(path, rule.pattern) for path in group.paths)]
    if (axis := plain_axis(rules)) is not None:
        up = [*(f"      # {_comment(rule.pattern)}: {_comment(rule.why)}." for rule in rules), f"      up: {axis}"]
    else:
        by_pattern = (f"        # {_comment(rule.why)}\n        {_quoted(rule.pattern)}: {rule.axis}" for rule in rules)
        up = ["      up: # by file pattern; the first match wins", *by_pattern]
    patterns = (f"        {_quoted(pattern)}: {_quoted(category)}" for pattern, category in group.category_map.items())
    return SOURCE.format(
        folder=_quoted(folder),
        weight=len(group.paths),
        scale_why="\n".join(f"      # {_comment(why)}." for why in group.why),
        scale=f"      scale: {group.factor:g}"
        + (f"\n      diagonal_m: {group.diagonal_m:g}" if group.diagonal_m else ""),
        up="\n".join(up),
        category_map="\n".join(patterns),
    )


def _quoted(text: str) -> str:
    """Text as YAML has it between double quotes; plain where nothing in it could be misread, as `no` and `0_1` are."""
    plain = re.fullmatch(r"[\w/.][\w/.-]*", text, re.ASCII) and parse_yaml(text) == text
    return text if plain else json.dumps(text, ensure_ascii=False)


def _comment(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


SMALLEST_M, LARGEST_M = 0.008, 20.0
"""Sizes of what a job of defaults can show: 2.5 m away, some cameras see no pixel of a smaller thing."""

MOST_NAMED = 5
"""Files with another axis than their neighbours that are named; the job has them all."""

MOST_UPS = 2
"""Levels by which the job file may lie beside the folder for the folder to be named from it."""


def main(options: argparse.Namespace) -> int:
    """`verso init`."""
    folder: Path = options.folder
    by = options.category_from
    if by not in (None, BY_FOLDER, BY_FILE, BY_PARENT) and not is_category(by):
        raise InputError(
            f"--category-from {plain_line(by)}: write folder, parent, file, or a name of letters, digits, - and _"
        )
    out: Path = options.out or Path(f"{dataset_name(folder)}.yaml")
    sheet: Path = options.sheet or out.with_suffix(".jpg")
    _check_targets(out, sheet)
    paths, unusable = walk_folder(folder)
    reading = _read(folder.resolve(), paths, [one.path for one in unusable])
    guess, items, more = make_guess(reading, by)
    left_out = sorted((*unusable, *reading.left_out, *more), key=lambda one: (one.reason in (PART, COPY), one.path))
    # What goes to a file or another program is not folded.
    width = shutil.get_terminal_size((100, 24)).columns if sys.stdout.isatty() else None
    if not items:
        print("\n".join(draw_left_out(left_out, width)), file=sys.stderr)
        raise AssetSourceError(
            f"{plain_line(str(folder), 300)}: none of its meshes can be used: {len(left_out)} left out"
        )
    near = os.path.relpath(folder.resolve(), out.parent.resolve())
    far = near.split("/")[: MOST_UPS + 1] == [".."] * (MOST_UPS + 1)
    categories = {item.path: item.category for item in items}
    text = write_job(
        dataset_name(folder), str(out), str(folder.resolve()) if far else near, sheet.name, categories, guess
    )
    job = check_text(text)
    catalogue = open_catalogue(job.assets, out.parent, tuple(job.categories))
    shown = show_items(catalogue, items)
    print("\n".join([*draw_table([one.row for one, _ in shown], width), *draw_left_out(left_out, width)]))
    pictured = [(one, partial(catalogue.load, ref)) for one, ref in shown]
    drawn = _draw(sheet, options.sheet is not None, f"{folder}: {plural(len(items), 'object')}", pictured, left_out)
    _write(out, text.encode(), "--out")
    print(f"{out}: {plural(len(items), 'object')} in {plural(len(job.categories), 'category')}")
    print("\n".join(f"  {line}" for line in describe_guess(guess)))
    look = f"  look at {sheet}, and change in {out} what is wrong; then" if drawn else "then"
    print(look, f"verso run {out} --scenes 8")
    if options.json:
        told = {"job": str(out), "sheet": str(sheet) if drawn else None, "categories": list(job.categories)}
        objects, others = [asdict(one) for one, _ in shown], [asdict(one) for one in left_out]
        print(json.dumps({"ok": True, **told, "objects": objects, "left_out": others}))
    return 0


def describe_guess(guess: Guess) -> list[str]:
    """A line for each unit and each axis that was guessed."""
    ups = [f"up: {rule.axis} in {rule.pattern}: {rule.why}" for rule in guess.ups if rule.pattern.startswith("**/")]
    others: dict[str, list[str]] = {}
    for rule in guess.ups:
        if not rule.pattern.startswith("**/"):
            others.setdefault(rule.why, []).append(f"{rule.pattern} {rule.axis}")
    for why, names in others.items():
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        ups.append(f"up differs: {', '.join(names[:MOST_NAMED])}{more}: {why}")
    return [why for group in guess.groups for why in group.why] + ups


def _check_targets(out: Path, sheet: Path) -> None:
    if sheet.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        raise InputError(f"--sheet {sheet}: must end in .jpg or .png")
    for path, asked in ((out, "--out"), (sheet, "--sheet")):
        if path.exists():
            raise OutputError(f"{path} is there already: remove it, or choose another {asked}")


def dataset_name(folder: Path) -> str:
    """A name for the job, after the folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", folder.resolve().name).strip("-._")[:64] or "meshes"


def make_guess(reading: Reading, category_from: str | None) -> tuple[Guess, list[Item], list[LeftOut]]:
    """What the job says, the files that it uses, and those that are another one again, or of no size for a table."""
    of = {path: group for group in guess_groups(reading.items) for path in group.paths}
    doubles = find_doubles(reading.items, lambda item: of[item.path].size_m(item), SUFFIXES)
    dropped = {one.path for one in doubles}
    different = [item for item in reading.items if item.path not in dropped]
    groups, kept, left_out = guess_groups(different), dict[str, Item](), list[LeftOut]()
    of = {path: group for group in groups for path in group.paths}
    for item in different:
        size = of[item.path].size_m(item)
        if SMALLEST_M <= size <= LARGEST_M:
            kept[item.path] = item
        else:
            how = "small to be seen on" if size < SMALLEST_M else "large for"
            why = f"is too {how} a table: {length(size)} at scale {of[item.path].factor:g}; put it into a folder of its own, "
            left_out.append(LeftOut(item.path, "size", f"{why}and init that"))
    categories = name_categories(kept, category_from)
    items = [replace(item, category=categories[path]) for path, item in kept.items()]
    others = {one.path for one in (*reading.left_out, *left_out, *doubles)}
    return (
        Guess(tuple(_map_groups(groups, categories, others, reading.refused)), tuple(guess_ups(items))),
        items,
        [*left_out, *doubles],
    )


def _map_groups(
    groups: Sequence[Group], categories: Mapping[str, str], others: Collection[str], refused: Collection[str]
) -> Iterator[Group]:
    """The groups with the files that are used, and patterns that find exactly these."""
    for group in groups:
        mine = {path: categories[path] for path in group.paths if path in categories}
        if mine:
            patterns = map_categories(mine, {*others, *(categories.keys() - mine.keys())}, refused)
            yield replace(group, paths=tuple(mine), category_map=patterns)


def check_text(text: str) -> Job:
    """The job of the text. InputError where it is longer than a job file may be."""
    if len(text.encode()) > MOST_BYTES:
        raise InputError(
            f"the job would have {len(text.encode())} bytes, because the files of a category do not lie together: put each "
            "category into a folder of its own, or name one with --category-from NAME"
        )
    return validate_job(parse_yaml(text, MOST_KEYS), "the new job")


def _read(folder: Path, paths: Sequence[str], beside: Sequence[str]) -> Reading:
    lines = dict[str, ProgressLine]()

    def watch(what: str, done: int, asked: int) -> None:
        lines.setdefault(what, ProgressLine(asked, what, "file")).show(done)

    try:
        return read_folder(folder, paths, watch, beside)
    finally:
        for line in lines.values():
            line.close()


def _draw(
    sheet: Path, asked: bool, title: str, shown: Sequence[tuple[Shown, Callable[[], Asset]]], left_out: list[LeftOut]
) -> bool:
    """Writes the pictures; whether it could. MachineError where they were asked for by name and cannot be drawn."""
    try:
        page = draw_sheet(title, shown, draw_left_out(left_out, None), shared_renderer())
    except MachineError as error:
        if asked:
            raise
        print(f"verso: no pictures: {error}", file=sys.stderr)
        return False
    data = io.BytesIO()
    page.save(data, "PNG" if sheet.suffix.lower() == ".png" else "JPEG", quality=88)
    _write(sheet, data.getvalue(), "--sheet")
    return True


def _write(path: Path, data: bytes, option: str) -> None:
    """Writes a new file. OutputError where it cannot be written, or is there by now."""
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True)
        with path.open("xb") as file:
            file.write(data)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}; choose another {option}") from error

"""`verso init`: a library of a folder of meshes, with a page of pictures of what was read and the job that uses it."""

import argparse
import hashlib
import io
import json
import math
import os
import re
import shutil
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from schemas.errors import (
    AssetSourceError,
    InputError,
    MachineError,
    MeshError,
    OutputError,
    VersoError,
    command_line,
    plain_line,
    plural,
)
from schemas.job.assets import TABLE, Assets, LibrarySource, MeshLimits, is_usable
from schemas.job.physics import Physics
from services.init.shown import MOST, cells_of, draw_left_out, draw_sheet, draw_table
from services.job.bounded_yaml import parse_yaml
from services.job.job_file import MOST_KEYS, load_job, validate_job
from services.run.parts import Cut, cut_shapes
from services.run.progress import finish, show_counts
from workers.assets.catalogue import Watch
from workers.assets.library.copies import COPY, PART
from workers.assets.library.guess import BY_FILE, BY_FOLDER, BY_PARENT, ON_TABLE_M, length
from workers.assets.library.making import Making, locked, remake_library
from workers.assets.library.shapes import load_shape, make_shapes, with_shape
from workers.assets.library.table import TABLE_FILE, Library, Row, write_table, write_whole
from workers.render.raster.gbuffer import shared_renderer

SCENES = 64

JOB_FILES, SHEET_FILE = {"tabletop": "job.yaml", "studio": "studio.yaml"}, "sheet.jpg"
"""Beside the table; a job for each kind of scene."""

MOST_MADE = 5000
"""Shapes up to which all are made at once; of more, those of the sheet: the others are made when a scene first uses them."""

HEAD = """\
# A dataset of your own meshes: {objects} in {categories}, from {folder}
# Written by `verso init`. What it decided stands in library.parquet, a row a file: look at the pictures ({sheet}), change
# what is wrong there (category, use, unit, up), and run `verso init` again.
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
    - source: library
      folder: . # this one
{sizes}      # With `copy_assets: true` the dataset holds the shapes too: see `licence` in the table.
      copy_assets: false
"""
TABLETOP = """\
  # What they stand on{tables}
# Cameras stand where objects fill 6 % of the input view, or a little less than that of what is long or near. The article's
# distances: radius_m: 2.5, T_z_m: 1.3. Depth begins nearer than by default, and a patch holds such an object.
cameras:
  orbit: {{radius_m: fit}}
  mirror: {{T_z_m: fit}}
images:
  depth_range_m: [0.05, 8.0]
  patch: {{width: 256, height: 192}}
start:
  # upright: as it stands in the pictures, at any yaw; tumbled: dropped in any rotation.
  pose: upright
"""
STUDIO = """\
# Each object alone on nothing, as it stands in the pictures; all are the same size. `scale: metric` keeps their own.
scene: studio
studio:
  scale: unit_sphere
  light: even
  background: transparent
cameras:
  sensor: {{width: 512, height: 512, fx: 560, fy: 560, cx: 256, cy: 256}}
  more:
    - name: around
      ring: {{count: 24, inclination_rad: 0.35, radius_m: fit}}
    # The cameras of a published method: zero123, syncdreamer, zero123plus, lrm or trellis.
    # - {{name: train, preset: zero123}}
targets:
  views: [normals]
"""
SIZES = "      # Objects keep their own size; `diagonal_m: 0.25` makes each as large as the article's objects are.\n"
BUILT_IN_TABLES = ": tables made from a seed.\n  tables:\n    - source: procedural\n"
OWN_TABLES = ": the library's own tables.\n  tables:\n    - source: library\n      folder: .\n"


def main(options: argparse.Namespace) -> int:
    """`verso init`."""
    folder: Path = options.folder
    out: Path = options.out or Path(f"{dataset_name(folder)}_library")
    making = read_making(options)
    holds = [path.name for path in out.iterdir()] if out.is_dir() else []
    if out.exists() and TABLE_FILE not in holds and (not out.is_dir() or set(holds) - {".lock"}):
        raise OutputError(f"{out} is there already, and no library: remove it, or choose another --out")
    with locked(out, wait=False):
        return _init(options, folder, out, making)


def _init(options: argparse.Namespace, folder: Path, out: Path, making: Making) -> int:
    """Makes the library and all that lies beside it, and tells of it."""
    with show_counts("meshes") as watch:
        library = fill_library(remake_library(folder, out, making, watch), watch, options.scene == "tabletop")
    used = [row for row in library.rows if row.use and row.category]
    left_out = sorted(
        (row for row in library.rows if row not in used), key=lambda row: (row.reason in (PART, COPY), row.path)
    )
    # What goes to a file or another program is not folded.
    width = shutil.get_terminal_size((100, 24)).columns if sys.stdout.isatty() else None
    if not used:
        print("\n".join(draw_left_out(left_out, width)), file=sys.stderr)
        raise AssetSourceError(
            f"{plain_line(str(folder), 300)}: none of its meshes can be used: {len(left_out)} left out"
        )
    print("\n".join([*draw_table([cells_of(row) for row in used], width), *draw_left_out(left_out, width)]))
    title = f"{folder}: {plural(len(used), 'object')}"
    asked = ask_about_large(used) if options.scene == "tabletop" else []
    job = out / JOB_FILES[options.scene]
    notes = [*asked, *draw_left_out(left_out, None)]
    sheet = out / SHEET_FILE if _draw(out / SHEET_FILE, title, library, used, notes) else None
    categories = sorted({row.category for row in used} - {TABLE})
    left = _write_job(job, options.scene, folder, used)
    print(f"{out}: {plural(len(used), 'object')} in {plural(len(categories), 'category')}")
    print("\n".join(f"  {line}" for line in (*describe_decisions(used), *library.plain, *asked, *filter(None, [left]))))
    look = f"  look at {sheet}, and change in {out / TABLE_FILE} what is wrong; then" if sheet else "  then"
    print(look, command_line("run", job, "--scenes", 8))
    tree = {"library": str(out), "job": str(job), "sheet": sheet and str(sheet), "categories": categories}
    return finish(options, True, **tree, objects=list(map(_plain, used)), left_out=list(map(_plain, left_out)))


def _plain(row: Row) -> dict[str, object]:
    return {name: value for name, value in asdict(row).items() if name not in ("files", "guessed")}


def read_making(options: argparse.Namespace) -> Making:
    """What the command line says of the folder. Raises InputError."""
    by = options.category_from
    if by not in (None, BY_FOLDER, BY_FILE, BY_PARENT, TABLE) and not is_usable(by):
        raise InputError(
            f"--category-from {plain_line(by)}: write folder, parent, file, or a name of letters, digits, - and _"
        )
    try:
        changes = dict(limit.partition("=")[::2] for limit in options.limit)
        limits = MeshLimits.model_validate(changes)
    except ValidationError as error:
        first = error.errors()[0]
        what = ", ".join(MeshLimits.model_fields) if first["type"] == "extra_forbidden" else first["msg"]
        raise InputError(f"--limit {plain_line(str(first['loc'][0]))}: write NAME=VALUE: {what}") from error
    if options.licence is not None and not (options.licence.strip() and options.licence.isprintable()):
        raise InputError("--licence: write some words")
    return Making(by, tuple(options.unit), options.up, options.licence, limits)


def fill_library(library: Library, watch: Watch, falls: bool = True) -> Library:
    """The library with its shapes made, all or of a large one those of the sheet, and its table written again.

    falls: whether convex parts are cut, which things that fall need.
    """
    used = [row for row in library.rows if row.use and row.category]
    asked = used if len(used) <= MOST_MADE else used[:MOST]
    made = dict[str, Row]()
    for done, (row, shape) in enumerate(make_shapes(library, asked, must_keep=True), 1):
        watch("made", done, len(asked))
        if isinstance(shape, MeshError) and shape.kind == "environmental":
            raise AssetSourceError(shape.detail)
        made[row.path] = with_shape(library, row, shape)
    shown = [row for row in (made.get(row.path, row) for row in used) if row.use][:MOST]
    counts = _count_parts(library, [row for row in shown if falls and row.category != TABLE])
    numbers = {row.path: k for k, row in enumerate(shown, 1)}
    filled = (made.get(row.path, row) for row in library.rows)
    rows = tuple(replace(row, picture=numbers.get(row.path), parts=counts.get(row.path)) for row in filled)
    library = replace(library, rows=rows)
    write_table(library)
    return library


def _count_parts(library: Library, rows: Sequence[Row]) -> dict[str, int]:
    """By path, how many convex parts a shape is dropped as in a pile. They are kept, so a job does not cut it again."""
    alone, settings, assets = replace(library, rows=()), LibrarySource(source="library", folder=os.curdir), Assets()
    cuts = [Cut(alone, row, settings, assets, row.instance_id, Physics().concavity) for row in rows]
    return {cut.row.path: count for cut, count, _ in cut_shapes(cuts) if count}


OURS = "# `verso init` writes this file anew unless you change it. As written it has the number "
"""The last line, with a digest of those above."""


def _write_job(job: Path, scene: str, folder: Path, used: Sequence[Row]) -> str:
    """Writes the job of this kind of scene beside the table; one that a person has changed stays.

    Returns what such a job has of categories that the library has not, and the other way round; empty where all is well.
    """
    counts = Counter(row.category for row in used)
    tables = counts.pop(TABLE, 0)
    if not counts:
        return ""
    there = job.read_text(encoding="utf-8", errors="replace") if job.exists() else ""
    if there and there != _with_number(there.partition(OURS)[0]):
        with suppress(VersoError):
            named = set(load_job(job).categories)
            new, gone = (", ".join(sorted(some)) for some in (counts.keys() - named, named - counts.keys()))
            parts = (f"it lacks {new}" if new else "", f"there is no {gone} any more" if gone else "")
            if both := "; ".join(filter(None, parts)):
                return f"{job} was changed and is left as it is: {both}: change its categories, or remove it"
        return ""
    on_table = scene == "tabletop"
    text = (HEAD + (TABLETOP if on_table else STUDIO)).format(
        objects=plural(counts.total(), "object"),
        categories=plural(len(counts), "category"),
        folder=_comment(str(folder)),
        sheet=SHEET_FILE,
        job=_comment(str(job)),
        name=dataset_name(folder) + ("" if on_table else "_studio"),
        sizes=SIZES if on_table else "",
        scenes=SCENES,
        weights="\n".join(
            f"  {_quoted(category)}: 1 # {plural(count, 'file')}" for category, count in sorted(counts.items())
        ),
        tables=OWN_TABLES if tables else BUILT_IN_TABLES,
    )
    validate_job(parse_yaml(text, MOST_KEYS), "the new job")
    write_whole(job, _with_number(f"{text}\n").encode())
    return ""


def _with_number(text: str) -> str:
    return f"{text}{OURS}{hashlib.sha256(text.encode()).hexdigest()[:16]}\n"


def _quoted(text: str) -> str:
    """Text as YAML has it between double quotes; plain where nothing in it could be misread, as `no` and `0_1` are."""
    plain = re.fullmatch(r"[\w/.][\w/.-]*", text, re.ASCII) and parse_yaml(text) == text
    return text if plain else json.dumps(text, ensure_ascii=False)


def _comment(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


MOST_NAMED = 5
"""Reasons that are told; the table has them all."""


def describe_decisions(used: Sequence[Row]) -> list[str]:
    """A line for each unit and axis that was decided, with how many files it is of."""
    reasons = Counter(part for row in used for part in row.why.split("; "))
    lines = [f"{why} ({plural(count, 'file')})" for why, count in reasons.most_common(MOST_NAMED)]
    return [*lines, f"and {len(reasons) - MOST_NAMED} more: see the table"] if len(reasons) > MOST_NAMED else lines


def ask_about_large(used: Sequence[Row]) -> list[str]:
    """The question about things that no table carries, with the answers there are; nothing where there is none."""
    sizes = {row.path: math.hypot(*row.extents_m or (0.0,)) for row in used if row.category != TABLE}
    large = sorted((path for path, size in sizes.items() if size > ON_TABLE_M[1]), key=lambda path: sizes[path])
    if not large:
        return []
    units = {row.path: row.unit for row in used}
    unit = f"{units[large[-1]] * ON_TABLE_M[1] / sizes[large[-1]]:.2g}"
    span = " to ".join(dict.fromkeys(length(sizes[path]) for path in (large[0], large[-1])))
    what = f"{plural(len(large), 'object')} of {span} ({large[-1]}) {'is' if len(large) == 1 else 'are'} too large for a table"
    return [
        f"? {what}. Run `verso init` again with",
        f"    --unit {unit}                 all files smaller, in proportion; or --unit 'PATTERN={unit}' for some",
        f"    --limit max_size_m={ON_TABLE_M[1]:g}        what is larger left out",
        "  or write diagonal_m: 0.25 in the job, which resizes every object. As it is, a scene that cannot be framed fails",
    ]


def dataset_name(folder: Path) -> str:
    """A name for the job, after the folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", folder.resolve().name).strip("-._")[:64] or "meshes"


def _draw(sheet: Path, title: str, library: Library, used: Sequence[Row], notes: Sequence[str]) -> bool:
    """Writes the pictures; whether it could."""
    try:
        renderer = shared_renderer()
    except MachineError as error:
        print(f"verso: no pictures: {error}", file=sys.stderr)
        return False
    settings = LibrarySource(source="library", folder=os.curdir)
    drawn = [(row, partial(load_shape, library, row, settings, Assets(), row.instance_id)) for row in used]
    page, data = draw_sheet(title, drawn, notes, renderer), io.BytesIO()
    page.save(data, "JPEG", quality=88)
    write_whole(sheet, data.getvalue())
    return True

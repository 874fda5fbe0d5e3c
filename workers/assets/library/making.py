"""Edge: makes a folder of meshes a library: what is used, of which category, unit and axis, decided once and written down.

A folder whose layout is known (ShapeNetCore, pybullet_data) or that is large is only listed, and its shapes are made when they
are asked for.
"""

import hashlib
import importlib.util
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from importlib.metadata import version
from pathlib import Path

from schemas.environment import cache_folder
from schemas.errors import AssetSourceError, OutputError, plain_line
from schemas.job.assets import BUILT_IN, TABLE, MeshLimits, UpAxis
from workers.assets.library.collection import (
    SUFFIXES,
    Survey,
    Watch,
    find_licence,
    ignore,
    list_licences,
    survey_folder,
    walk_folder,
)
from workers.assets.library.copies import COPY, PART, Item, LeftOut, find_copies, find_doubles
from workers.assets.library.guess import find_joined, guess_groups, guess_ups, length, name_categories
from workers.assets.library.table import (
    SHAPENET_LICENCE,
    TABLE_FILE,
    Library,
    Row,
    SourceFile,
    keep_edits,
    read_table,
    with_guess,
    write_table,
)
from workers.pool import Answers, alone_in
from workers.source import code_digest

MOST_READ = 5000
"""Candidates up to which all are read before anything is decided; of more, so many are, evenly spaced."""

SAMPLE = 256

SMALLEST_M, LARGEST_M = 0.008, 20.0
"""Sizes of what a job of defaults can show: 2.5 m away, some cameras see no pixel of a smaller thing."""

SYNSETS: Mapping[str, str] = {row.synset: row.name for row in BUILT_IN.values() if row.synset is not None}
_MESHES = ("models/model_normalized.obj", "model.obj")
"""Where the mesh lies in a folder of ShapeNetCore's models: version 2, version 1."""
OBJECT_UNIT, TABLE_UNIT = 0.25, 1.5
"""The article's factors on ShapeNetCore's normalised units."""

PYBULLET_DATA = "pybullet_data"
_PYBULLET = (("objects/mug.urdf", "mug"), ("table/table.urdf", TABLE), ("table_square/table_square.urdf", TABLE))
"""The category of each mesh inside that package which has one; those of `random_urdfs` go for boxes."""


USUAL_LIMITS = MeshLimits()


@dataclass(frozen=True)
class Making:
    """How a folder becomes a library: in place of a guess, one category or its kind of name, units, axis, licence; limits.

    units: of the files whose paths a pattern of the shell fits; the last that does.
    """

    category_from: str | None = None
    units: tuple[tuple[str, float], ...] = ()
    up: UpAxis | None = None
    licence: str | None = None
    limits: MeshLimits = USUAL_LIMITS

    def unit_of(self, path: str) -> float | None:
        """The unit that was asked for, metres."""
        return next((unit for pattern, unit in reversed(self.units) if fnmatchcase(path, pattern)), None)


def open_library(name: str, job_folder: Path, watch: Watch = ignore) -> Library:
    """The library in a folder, or the one that is made of a folder of meshes, in the user's cache.

    Raises AssetSourceError where neither can be.
    """
    folder = locate_folder(name, job_folder)
    if (folder / TABLE_FILE).exists():
        library = read_table(folder)
        _check_shapes(library)
        return library
    if not folder.is_dir():
        raise AssetSourceError(
            f"{folder} is not a folder. Set `folder` of the source to a library, a folder of meshes, or `{PYBULLET_DATA}`."
        )
    cache = cache_folder("libraries")
    digest = hashlib.sha256(str(folder).encode()).hexdigest()[:16]
    out = None if cache is None else cache / code_version() / f"{folder.name[:40]}-{digest}"
    return make_library(folder, out, Making(), watch)


def _check_shapes(library: Library) -> None:
    """AssetSourceError where a GLB is gone, or of another size, and its source is not here to make it again."""
    if library.source.is_dir():
        return
    for row in library.rows:
        if not row.use or not row.category:
            continue
        path = library.folder / (row.glb or row.glb_path)
        size = path.stat().st_size if path.is_file() else None
        if size is None or size != row.glb_bytes:
            what = "is missing" if size is None else "is not what library.parquet says"
            raise AssetSourceError(
                f"{plain_line(str(path), 300)} {what}, and {plain_line(str(library.source), 300)}, of which it was made, is "
                "not here: copy the library again, or `verso init` where the source is"
            )


@cache
def code_version() -> str:
    """Digest of the code that decisions and shapes depend on, and of the versions of libraries."""
    names = ("manifold3d", "numpy", "pillow", "scipy", "trimesh")
    return hashlib.sha256(repr([code_digest(), *map(version, names)]).encode()).hexdigest()[:16]


def locate_folder(name: str, job_folder: Path) -> Path:
    """The folder of a source: relative to the job file, or that of the installed package pybullet_data, not imported."""
    if name == PYBULLET_DATA and not (job_folder / name).is_dir():
        spec = importlib.util.find_spec(PYBULLET_DATA)
        if spec is None or not spec.submodule_search_locations:
            raise AssetSourceError("the package pybullet_data is not installed: `pip install pybullet` brings it")
        return Path(spec.submodule_search_locations[0]).resolve()
    try:
        return (job_folder / Path(name).expanduser()).resolve()
    except RuntimeError as error:
        raise AssetSourceError(f"{name}: there is no such user, or no home folder") from error


def locked(folder: Path, wait: bool) -> AbstractContextManager[None]:
    """Within the block no other process makes the library in this folder. Raises InUseError, or waits."""
    return alone_in(folder, ".lock", "verso init", wait)


def make_library(source: Path, out: Path | None, making: Making, watch: Watch = ignore) -> Library:
    """Decides about every candidate of a folder and writes the table into `out`, where it can be written.

    Raises AssetSourceError where the folder cannot be used.
    """
    source = source.resolve()
    library = Library(out or Path(os.devnull), source, making.limits, ())
    if out is not None:
        with suppress(OutputError), locked(out, wait=True):
            library = replace(library, rows=decide_rows(source, making, watch))
            write_table(library)
    return library if library.rows else replace(library, rows=decide_rows(source, making, watch))


def remake_library(source: Path, out: Path, making: Making, watch: Watch = ignore) -> Library:
    """As `make_library` in a `locked` folder; what a person has changed in an earlier table there stays.

    Raises OutputError where the table cannot be written.
    """
    source = source.resolve()
    rows = decide_rows(source, making, watch)
    if (out / TABLE_FILE).exists():
        rows = keep_edits(rows, read_table(out))
    library = Library(out, source, making.limits, rows)
    write_table(library)
    return library


def decide_rows(source: Path, making: Making, watch: Watch = ignore) -> tuple[Row, ...]:
    """A row for each candidate below a folder, in the order of their paths."""
    if any((source / synset).is_dir() for synset in SYNSETS):
        rows = list(_shapenet(source))
    elif source.name == PYBULLET_DATA and (source / "table/table.urdf").is_file():
        rows = list(_pybullet(source))
    else:
        rows = _guess_rows(source, making, watch)
    changed = [
        replace(
            row,
            unit=making.unit_of(row.path) or row.unit,
            up=making.up or row.up,
            licence=making.licence or row.licence,
            why=row.why if not row.use or (making.unit_of(row.path) is None and making.up is None) else "as asked for",
        )
        for row in rows
    ]
    return tuple(with_guess(row) for row in sorted(changed, key=lambda row: row.path))


def _listed(source: Path, path: str) -> tuple[SourceFile, ...]:
    stat = (source / path).stat()
    return (SourceFile(path, stat.st_size, stat.st_mtime_ns),)


def _shapenet(source: Path) -> Iterator[Row]:
    for synset, category in SYNSETS.items():
        if not (source / synset).is_dir():
            continue
        with os.scandir(source / synset) as models:
            names = sorted(model.name for model in models if model.is_dir())
        for name in names:
            row = Row(
                path=f"{synset}/{name}/{_MESHES[-1]}",
                category=category,
                unit=TABLE_UNIT if category == TABLE else OBJECT_UNIT,
                up="y",
                licence=SHAPENET_LICENCE,
                why="ShapeNetCore",
            )
            for mesh in _MESHES:
                path = f"{synset}/{name}/{mesh}"
                if (source / path).is_file():
                    yield replace(row, path=path, files=_listed(source, path))
                    break
            else:
                yield replace(row, use=False, reason="missing", why="has no mesh")


def _pybullet(source: Path) -> Iterator[Row]:
    boxes = sorted((source / "random_urdfs").glob("*/*.urdf"))
    known = (*_PYBULLET, *((path.relative_to(source).as_posix(), "box") for path in boxes))
    for path, category in known:
        if (source / path).is_file():
            yield Row(path=path, category=category, why="pybullet_data", files=_listed(source, path))


def _guess_rows(source: Path, making: Making, watch: Watch) -> list[Row]:
    paths, unusable = walk_folder(source)
    beside = [left.path for left in unusable]
    copies = find_copies(paths, [*paths, *beside])
    left_out = {path: LeftOut(path, COPY, why) for path, why in copies.items()}
    asked = [path for path in paths if path not in left_out]
    folder = cache_folder("surveys")
    kept = Answers(None if folder is None else folder / code_version())
    every = max(1, -(-len(asked) // SAMPLE)) if len(asked) > MOST_READ else 1
    surveys = survey_folder(source, asked[::every], making.limits, kept, watch)
    for survey in surveys:
        for part in set(survey.named) & set(paths):
            if part not in left_out or left_out[part].reason == COPY:  # a file that names it is surer than its name
                left_out[part] = LeftOut(part, PART, f"part of {survey.path}")
    licences = list_licences(source)
    is_large = every > 1
    rows = _apply_sample(source, asked, surveys, making) if is_large else _decide(surveys, left_out, making)
    rows = [replace(row, licence=find_licence(source / row.path, source, licences)) for row in rows]
    listed = {row.path for row in rows}
    aside = [left for left in (*unusable, *left_out.values()) if left.path not in listed]
    return rows + [Row(path=left.path, use=False, reason=left.reason, why=left.why) for left in aside]


def _decide(surveys: Sequence[Survey], left_out: Mapping[str, LeftOut], making: Making) -> list[Row]:
    """The rows of candidates that were all read."""
    known = [survey for survey in surveys if survey.path not in left_out]
    items = [Item(s.path, s.measured, s.digest) for s in known if s.measured is not None]
    of = {path: group for group in guess_groups(items) for path in group.paths}

    def size_m(item: Item) -> float:
        return (making.unit_of(item.path) or of[item.path].unit(item)) * item.diagonal

    fit = [item for item in items if SMALLEST_M <= size_m(item) <= LARGEST_M]
    doubles = {double.path: double for double in find_doubles(fit, size_m, SUFFIXES)}
    different = [item for item in items if item.path not in doubles]
    same = [item for item in items if item.path in doubles]
    of = {path: group for group in guess_groups(different, same) for path in group.paths}
    ups = guess_ups(different, same)
    objects = [survey.path for survey in known if survey.path not in doubles]
    categories, joined = name_categories(objects, making.category_from), find_joined(objects, making.category_from)
    by_path, rows = {item.path: item for item in items}, []
    for survey in known:
        row = Row(path=survey.path, files=survey.files, sha256=survey.files[0].sha256 if survey.files else "")
        if survey.path in doubles:
            rows.append(replace(row, use=False, reason=COPY, why=doubles[survey.path].why))
            continue
        row = replace(row, category=categories[survey.path])
        if survey.measured is None:
            rows.append(replace(row, use=False, reason=survey.refused[0], why=survey.refused[1]))
            continue
        item = by_path[survey.path]
        unit, (up, why) = making.unit_of(item.path) or of[item.path].unit(item), ups[item.path]
        row = _measured(replace(row, unit=unit, up=making.up or up), survey, why, of[item.path].why)
        if row.category in joined:
            row = replace(row, why=f"{row.why}; {joined[row.category]}")
        rows.append(_sized(row, item))
    return rows


def _measured(row: Row, survey: Survey, why: str, units: Sequence[str]) -> Row:
    assert survey.measured is not None
    measured = survey.measured
    x, y, z = (row.unit * extent for extent in measured.extents)
    return replace(
        row,
        why="; ".join(
            [*(line for line in units if line.startswith(Path(row.path).suffix.lower())), f"{row.up} up: {why}"]
        ),
        extents_m={"x": (z, y, x), "y": (x, z, y), "z": (x, y, z)}[row.up],
        faces=measured.faces,
        watertight=measured.watertight,
        pictures=measured.textures,
        shape_up=measured.up,
        sure=None if measured.confidence is None else measured.sure_of(row.up) is not None,
        mended=measured.notes,
    )


def _sized(row: Row, item: Item) -> Row:
    size = row.unit * item.diagonal
    if SMALLEST_M <= size <= LARGEST_M:
        return row
    how = "small to be seen on" if size < SMALLEST_M else "large for"
    why = f"is too {how} a table: {length(size)} at {row.unit:g} m a unit; change its `unit` and `use` in the table"
    return replace(row, use=False, reason="size", why=why, category="")


def _apply_sample(source: Path, paths: Sequence[str], surveys: Sequence[Survey], making: Making) -> list[Row]:
    """The rows of a large folder: each format has the unit and the axis of most of those that were read."""
    rows = _decide(surveys, {}, making)
    units, ups = dict[str, Counter[float]](), dict[str, Counter[UpAxis]]()
    for row in rows:
        if row.use:
            suffix = Path(row.path).suffix.lower()
            units.setdefault(suffix, Counter())[row.unit] += 1
            ups.setdefault(suffix, Counter())[row.up] += 1
    categories = name_categories(paths, making.category_from)
    made = []
    for path in paths:
        suffix = Path(path).suffix.lower()
        unit = units[suffix].most_common(1)[0][0] if suffix in units else 1.0
        up: UpAxis = ups[suffix].most_common(1)[0][0] if suffix in ups else "z"
        why = (
            f"as most of {sum(units[suffix].values())} {suffix} files that were read"
            if suffix in units
            else "not known"
        )
        files = _listed(source, path)
        made.append(Row(path=path, category=categories[path], unit=unit, up=up, why=why, files=files))
    return made

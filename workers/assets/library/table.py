"""Pure but for its file: the table of a library of shapes, a row for each candidate of a folder, which a person may edit."""

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.errors import AssetSourceError, OutputError, plain_line, plural
from schemas.job.assets import TABLE, MeshLimits, UpAxis, is_usable

TABLE_FILE = "library.parquet"
SHAPES = "shapes"
"""The folder of the GLBs, beside the table."""

VERSION = 1
"""Of a library: raised where an older one cannot be read as it is."""

PLAIN = "no picture, and no colour but one grey"
"""A note on a shape."""

UNKNOWN = "unknown"
"""The licence of shapes of which nobody states one."""


@dataclass(frozen=True)
class SourceFile:
    """A file of the source's folder: path below it, bytes, time of change, SHA-256; empty where it was not read."""

    path: str
    bytes: int
    mtime_ns: int
    sha256: str = ""


@dataclass(frozen=True)
class Row:
    """A candidate: what was decided about it, what was measured of it, and what was made of it; None: not yet known.

    path: its first file, below the source's folder; category: empty where it is no object by itself; use: whether it may be
    drawn, and otherwise why not: reason, a word, and why, a sentence. unit: metres in a unit of its files; up: the axis that
    points up in them; category, use, unit and up may be edited. files: all that it is read from. extents_m: of its bounding
    box as it stands; shape_up, sure: which axis its shape says is up; pictures: of its parts; mended: what was repaired, or
    left out and drawn without. scale, mass_kg (at the default density), volume_m3, glb_bytes, glb_sha256: of its GLB; parts:
    how many convex ones it is dropped as; picture: its number on the sheet.
    """

    path: str
    sha256: str = ""
    licence: str = UNKNOWN
    category: str = ""
    use: bool = True
    unit: float = 1.0
    up: UpAxis = "z"
    reason: str = ""
    why: str = ""
    guessed: str = ""
    extents_m: tuple[float, ...] | None = None
    faces: int | None = None
    watertight: bool | None = None
    pictures: int | None = None
    shape_up: str | None = None
    sure: bool | None = None
    mended: tuple[str, ...] = ()
    scale: float | None = None
    mass_kg: float | None = None
    volume_m3: float | None = None
    parts: int | None = None
    glb: str | None = None
    glb_bytes: int | None = None
    glb_sha256: str | None = None
    picture: int | None = None
    files: tuple[SourceFile, ...] = ()

    @cached_property
    def key(self) -> str:
        """Digest of all that its GLB follows from: the paths, bytes and digests of its files, its unit, and its axis."""
        files = [(file.path, file.bytes, file.sha256) for file in self.files]
        return hashlib.sha256(json.dumps([files, float(self.unit), self.up, VERSION]).encode()).hexdigest()[:32]

    @cached_property
    def instance_id(self) -> str:
        """Synset and model of ShapeNetCore; else its path as one word, and eight digits of its key."""
        parts = PurePosixPath(self.path).parts
        if self.licence == SHAPENET_LICENCE:
            return "-".join(parts[:2])
        stem = str(PurePosixPath(self.path).with_suffix(""))
        word = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "-" for c in stem)[-MOST_LETTERS:]
        return f"{word}-{self.key[:8]}"

    @property
    def glb_path(self) -> str:
        """Where its GLB lies below the library's folder, once it is made."""
        return f"{SHAPES}/{self.instance_id}.glb"


MOST_LETTERS = 150
"""Of a path in the name of an instance, which names a file."""

SHAPENET_LICENCE = "ShapeNet terms of use: non-commercial research"

_FILE = pa.struct([("path", pa.string()), ("bytes", pa.int64()), ("mtime_ns", pa.int64()), ("sha256", pa.string())])
_TYPES = {
    **dict.fromkeys(
        ["path", "sha256", "licence", "category", "up", "reason", "why", "guessed", "shape_up", "glb", "glb_sha256"],
        pa.string(),
    ),
    **dict.fromkeys(["use", "watertight", "sure"], pa.bool_()),
    **dict.fromkeys(["unit", "scale", "mass_kg", "volume_m3"], pa.float64()),
    **dict.fromkeys(["faces", "pictures", "parts", "glb_bytes", "picture"], pa.int64()),
    "extents_m": pa.list_(pa.float64()),
    "mended": pa.list_(pa.string()),
    "files": pa.list_(_FILE),
}
SCHEMA = pa.schema([("library", pa.string()), *((field.name, _TYPES[field.name]) for field in fields(Row))])
"""`library`: the version, the source's folder and its limits, as JSON in each row: programs that edit a table drop what lies
beside its columns."""


@dataclass(frozen=True)
class Library:
    """A library of shapes: where it lies, the folder that it was made of, and its rows in the order of their paths."""

    folder: Path
    source: Path
    limits: MeshLimits
    rows: tuple[Row, ...]

    @cached_property
    def entries(self) -> Mapping[str, tuple[Row, ...]]:
        """The rows by category, in order; those that are not used too, so that leaving one out moves no other draw."""
        entries: dict[str, list[Row]] = {}
        for row in self.rows:
            if row.category:
                entries.setdefault(row.category, []).append(row)
        return {category: tuple(rows) for category, rows in sorted(entries.items())}

    @cached_property
    def places(self) -> Mapping[str, tuple[str, int]]:
        """(category, number among its rows) of every shape that may be used, by its instance id."""
        rows = ((name, n, row) for name, rows in self.entries.items() for n, row in enumerate(rows))
        return {row.instance_id: (name, n) for name, n, row in rows if row.use}

    def count(self, category: str) -> int:
        """How many rows of a category may be used."""
        return sum(row.use for row in self.entries.get(category, ()))

    @cached_property
    def skipped(self) -> Mapping[str, int]:
        """How many candidates cannot be used, by reason."""
        return dict(sorted(Counter(row.reason for row in self._refused).items()))

    @property
    def examples(self) -> tuple[str, ...]:
        """A sentence on the first of them."""
        return tuple(plain_line(f"{row.path} ({row.reason}: {row.why:.300})", 1000) for row in self._refused[:EXAMPLES])

    @property
    def _refused(self) -> list[Row]:
        return [row for row in self.rows if row.category and not row.use and row.reason]

    @property
    def doubts(self) -> Mapping[str, str]:
        """By path, the axis on which alone a file stands where `up` names another."""
        return {row.path: str(row.shape_up) for row in self.rows if row.use and row.sure and row.shape_up != row.up}

    @property
    def plain(self) -> list[str]:
        """A sentence on the shapes that no file gives a picture or a colour; none where all have one."""
        used = [row for row in self.rows if row.use and row.category not in ("", TABLE)]
        plain = [row.path for row in used if PLAIN in row.mended]
        some = f" and {len(plain) - EXAMPLES} more" if len(plain) > EXAMPLES else ""
        return (
            [f"{len(plain)} of {plural(len(used), 'shape')}: {PLAIN} ({', '.join(plain[:EXAMPLES])}{some})"]
            if plain
            else []
        )

    @property
    def licences(self) -> Counter[str]:
        """How many shapes that may be used have a licence."""
        return Counter(row.licence for row in self.rows if row.use and row.category)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that the choice and the shapes follow from, wherever they lie."""
        whole = [[row.instance_id, row.category, row.use, row.licence, row.key] for row in self.rows if row.category]
        return hashlib.sha256(json.dumps(whole).encode()).hexdigest()

    def __getstate__(self) -> dict[str, object]:
        """Without what is made of the rows when it is asked for."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


EXAMPLES = 3
"""Candidates that cannot be used of which a message tells."""


def write_table(library: Library) -> None:
    """Writes the table, whole or not at all. Raises OutputError where it cannot be written."""
    about = {
        "version": VERSION,
        "folder": str(library.source),
        "limits": library.limits.model_dump(exclude_defaults=True),
    }
    text = json.dumps(about, sort_keys=True)
    columns = {name: [getattr(row, name) for row in library.rows] for name in _TYPES if name != "files"}
    columns["files"] = [[vars(file) for file in row.files] for row in library.rows]
    table = pa.table({"library": [text] * len(library.rows), **columns}, schema=SCHEMA)
    path = library.folder / TABLE_FILE
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    write_whole(path, sink.getvalue().to_pybytes())


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file under another name and renames it. Raises OutputError where it cannot be written."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(data)
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error


def read_table(folder: Path) -> Library:
    """The library in a folder. Raises AssetSourceError, in a line, where its table is none, or of another version."""
    path = folder / TABLE_FILE
    name = plain_line(str(path), 300)
    try:
        table = pq.read_table(path, memory_map=False)
        if missing := [column for column in SCHEMA.names if column not in table.column_names]:
            raise ValueError(f"it has no column {missing[0]}")
        rows = table.select(SCHEMA.names).cast(SCHEMA).to_pylist()
        if not rows:
            raise ValueError("it has no row")
        about = json.loads(rows[0]["library"])
        version, source = about["version"], Path(about["folder"])
    except (pa.ArrowException, ValueError, TypeError, KeyError, OSError, OverflowError) as error:
        message = plain_line(str(error).splitlines()[0] if str(error) else repr(error), 200)
        raise AssetSourceError(f"{name} is no table of a library: {message}; `verso init` makes it again") from error
    if version != VERSION:
        raise AssetSourceError(
            f"{name} is of version {version!r:.20}, and this program reads {VERSION}: `verso init` again"
        )
    try:
        limits = MeshLimits.model_validate(about["limits"])
        made = tuple(_row(row) for row in rows)
    except (ValueError, TypeError, KeyError) as error:
        raise AssetSourceError(f"{name}: {plain_line(str(error), 300)}") from error
    if twice := [path for path, count in Counter(row.path for row in made).items() if count > 1]:
        raise AssetSourceError(f"{name}: {plain_line(twice[0])} has two rows")
    return Library(folder, source, limits, made)


def _row(tree: dict) -> Row:
    """A row of the table. ValueError that names its path where a value cannot be."""
    path = tree["path"]
    if not path or path.startswith("/") or ".." in PurePosixPath(path).parts:
        raise ValueError(f"path {path!r}: must lie below the source's folder")
    for name, fits, rule in (
        ("up", tree["up"] in ("x", "y", "z"), "must be x, y or z"),
        ("unit", tree["unit"] is not None and 0.0 < tree["unit"] < math.inf, "must be a positive number, metres"),
        ("use", tree["use"] is not None, "must be true or false"),
        (
            "category",
            tree["category"] is not None and (tree["category"] in ("", TABLE) or is_usable(tree["category"])),
            "must be letters, digits, - and _, the first a letter",
        ),
        ("licence", bool(tree["licence"]), "must be some words"),
        ("files", bool(tree["files"]) and tree["files"][0]["path"] == path, "must begin with path"),
    ):
        if not fits and (name != "files" or tree["use"]):
            raise ValueError(f"{path}: {name} {tree[name]!r:.60}: {rule}")
    files = tuple(SourceFile(**file) for file in tree["files"] or ())
    extents = None if tree["extents_m"] is None else tuple(tree["extents_m"])
    values = {field.name: tree[field.name] for field in fields(Row)}
    plain = {name: value or "" for name, value in values.items() if name in ("sha256", "reason", "why", "guessed")}
    return Row(**{**values, **plain, "files": files, "extents_m": extents, "mended": tuple(tree["mended"] or ())})


def keep_edits(rows: tuple[Row, ...], before: Library) -> tuple[Row, ...]:
    """The rows as a person has decided in an earlier table: what differs there from what had been guessed stays."""
    known = {row.path: row for row in before.rows}
    return tuple(_edited(row, known[row.path]) if row.path in known else row for row in rows)


def _edited(row: Row, before: Row) -> Row:
    guessed = json.loads(before.guessed or "{}")
    edits = {name: getattr(before, name) for name in guessed if getattr(before, name) != guessed[name]}
    if not edits:
        return row
    if "use" in edits:
        edits |= {"reason": "", "why": ""} if edits["use"] else {"reason": "edited", "why": "left out by hand"}
    if edits.get("use") and row.reason not in ("", "part", "copy", "size", "edited"):
        del edits["use"], edits["reason"], edits["why"]  # it cannot be read
    return replace(row, **edits)


EDITABLE = ("category", "use", "unit", "up")


def with_guess(row: Row) -> Row:
    """The row with what was guessed of it, by which a later `init` knows what a person has changed."""
    return replace(row, guessed=json.dumps({name: getattr(row, name) for name in EDITABLE}))

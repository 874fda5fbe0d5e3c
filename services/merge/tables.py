"""The merged files: manifest tables by category, the article's camPoses.csv, cameras.csv and objects.dat, and DATASET.md.

Tables are written in files of about 100,000 rows, the text files in blocks of lines (dataset.md section 1).
"""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.dataset.layout import (
    ARTICLE,
    CAM_POSES,
    CAMERAS,
    FINGERPRINT_FILE,
    JOB_FILE,
    OBJECTS,
    README_FILE,
    merged_table_path,
    stored_roles,
    view_name,
)
from schemas.dataset.shard import Fingerprint
from schemas.dataset.tables import SCHEMAS
from schemas.errors import CorruptError
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Captures
from schemas.job.job import Job
from schemas.scene.view import ROLES, Role
from services.job.record import JobRecord
from workers.store.commit import is_sealed, seal
from workers.store.manifest import PARQUET_OPTIONS, TableDigest, row_keys
from workers.store.store import Store

if TYPE_CHECKING:
    from workers.assets.catalogue import Catalogue

ROWS_PER_FILE = 100_000
ROWS_PER_GROUP = 8_192
"""Rows of a Parquet row group; also how many rows of a table wait before they are split by category."""
WAITING_BYTES = 12 << 20
"""Memory for the rows of one table that wait to be split, and as much behind that in all categories together."""


class MergedTable:
    """Writes one table below `folder` as hive partitions, and digests its rows."""

    def __init__(self, table: str, folder: Path) -> None:
        self.digest = TableDigest(table)
        self._table = table
        self._folder = folder
        self._parts: dict[str, _Parts] = {}
        self._waiting: list[pa.Table] = []
        self._last_key: list[tuple] = []

    def add(self, rows: pa.Table) -> None:
        """Takes the next rows, best some thousands, sorted by key. Raises CorruptError where a key does not rise."""
        keys = row_keys(self._table, rows)
        for before, after in pairwise([*self._last_key, *keys]):
            if before >= after:
                raise CorruptError(
                    f"{self._table}: the key {after} comes after {before}: the ranges do not join; "
                    "`verso verify OUT` lists what is damaged"
                )
        self._last_key = keys[-1:] or self._last_key
        self.digest.update(rows)
        self._waiting += [rows] if keys else []
        if _bytes_of(self._waiting) >= WAITING_BYTES or sum(map(len, self._waiting)) >= ROWS_PER_GROUP:
            self._split()

    def finish(self, categories: list[str]) -> dict[str, Path]:
        """The finished files by key. An empty table gets one empty file under the first of `categories`."""
        self._split()
        parts = self._parts or {categories[0]: _Parts(self._table, categories[0], self._folder)}
        return {key: path for part in parts.values() for key, path in part.finish().items()}

    @property
    def categories(self) -> set[str]:
        """Those that have rows so far."""
        self._split()
        return set(self._parts)

    def _split(self) -> None:
        """Gives the rows to their categories; where those hold too much then, the largest write theirs."""
        rows = pa.concat_tables([SCHEMAS[self._table].empty_table(), *self._waiting])
        self._waiting = []
        column = rows.column("category")
        for category in sorted(column.unique().to_pylist()):
            parts = self._parts.setdefault(category, _Parts(self._table, category, self._folder))
            parts.waiting.append(rows.filter(pc.equal(column, category)).drop_columns("category"))
            if sum(map(len, parts.waiting)) >= ROWS_PER_GROUP:
                parts.flush()
        while sum(_bytes_of(parts.waiting) for parts in self._parts.values()) > WAITING_BYTES:
            max(self._parts.values(), key=lambda parts: _bytes_of(parts.waiting)).flush()


def _bytes_of(tables: Sequence[pa.Table]) -> int:
    return sum(rows.nbytes for rows in tables)


class _Parts:
    """The files of one category of one table. As there may be hundreds, a file is open only while it is written."""

    def __init__(self, table: str, category: str, folder: Path) -> None:
        self._path_of = lambda number: merged_table_path(table, category, number)
        self._folder = folder
        self._empty = SCHEMAS[table].empty_table().drop_columns("category")
        self.waiting: list[pa.Table] = []
        """Rows without their category that are not yet written."""
        self._files: dict[str, Path] = {}
        self._writer: pq.ParquetWriter | None = None
        self._sink = _Sink()
        self._room = 0
        """Rows that the open file still takes."""

    def finish(self) -> dict[str, Path]:
        """Ends the last file; the files by key."""
        if self.waiting or not self._files:
            self.flush()
        self._end_file()
        return self._files

    def flush(self) -> None:
        """Writes the rows that wait, or an empty file where there has been none."""
        rows = pa.concat_tables([self._empty, *self.waiting])
        self.waiting = []
        while rows.num_rows or not self._files:
            if self._writer is None:
                key = self._path_of(len(self._files))
                self._files[key] = self._folder / key
                self._files[key].parent.mkdir(parents=True, exist_ok=True)
                self._writer, self._room = pq.ParquetWriter(self._sink, rows.schema, **PARQUET_OPTIONS), ROWS_PER_FILE
            piece = rows.slice(0, self._room)
            self._writer.write_table(piece, row_group_size=ROWS_PER_GROUP)
            self._store()
            self._room -= piece.num_rows
            rows = rows.slice(piece.num_rows)
            if not self._room:
                self._end_file()

    def _end_file(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._store()
            self._writer = None

    def _store(self) -> None:
        """Moves what the writer wrote since the last call to the file on the disk."""
        with open(list(self._files.values())[-1], "ab") as file:
            file.write(self._sink.getvalue())
        self._sink.seek(0)
        self._sink.truncate()


class _Sink(io.BytesIO):
    """Memory that a Parquet writer writes to."""

    def close(self) -> None:
        """Does nothing: what the writer wrote last is still to be stored."""


_ELEMENTS = [f"T{row}{column}" for row in range(4) for column in range(4)]
_CAMERA_COLUMNS = [
    *("pose_id", "parent_id", "role", "width", "height", "fx", "fy", "cx", "cy"),
    *("cx_opencv", "cy_opencv", "depth_units_per_m"),
]
_UNSAFE = re.compile(r"[%\s\x00-\x1f\x7f]")


class PoseFiles:
    """The three files in `folder`; takes whole ranges in order. A file is open only while it is written."""

    def __init__(self, folder: Path) -> None:
        self.paths = {name: folder / name for name in (CAM_POSES, CAMERAS, OBJECTS)}
        headers = (["id", "parent_id", *_ELEMENTS], [*_CAMERA_COLUMNS, *_ELEMENTS])
        self._append(*((",".join(words) + "\n").encode() for words in headers), b"")

    def add(self, views: pa.Table, objects: pa.Table) -> None:
        """Takes the next ranges' rows of both tables."""
        self._append(cam_pose_lines(views), camera_lines(views), object_lines(objects))

    def _append(self, *lines: bytes) -> None:
        for path, more in zip(self.paths.values(), lines, strict=True):
            with open(path, "ab") as file:
                file.write(more)


def cam_pose_lines(views: pa.Table) -> bytes:
    """`id,parent_id,T00,...,T33` for the input and mirror cameras among rows sorted by pose id."""
    return _lines(_poses(views), ["pose_id", "parent_id", "T_world_cam"], ",")


def camera_lines(views: pa.Table) -> bytes:
    """One line for each camera, by pose id and then in the order input, aligned, mirror, projected, and named cameras.

    The role of a named camera is its view's name, such as `around_003`.
    """
    poses, roles, numbers = (views.column(name).to_pylist() for name in ("pose_id", "role", "number"))
    order = sorted(range(len(views)), key=lambda row: (poses[row], *_place(roles[row], numbers[row])))
    names = pa.array(list(map(view_name, roles, numbers)), pa.string())
    named = views.set_column(views.column_names.index("role"), "role", names)
    return _lines(named.take(pa.array(order, pa.int64())), [*_CAMERA_COLUMNS, "T_world_cam"], ",")


def _place(role: Role, number: int | None) -> tuple[int, str, int]:
    """Where a view stands among those of its pose."""
    return (ROLES.index(role), "", 0) if number is None else (len(ROLES), role, number)


def object_lines(objects: pa.Table) -> bytes:
    """`pose_id category instance region u v T00 ... T33` for everything that input and mirror cameras see.

    White space and `%` in names are written as in a URL (`my%20mug`), so every line has 22 words.
    """
    columns = ["pose_id", "category", "instance_id", "region_id", "u", "v", "T_cam_obj"]
    return _lines(_poses(objects), columns, " ")


def escaped(name: str) -> str:
    """A name as one word; `urllib.parse.unquote` reverses it."""
    return _UNSAFE.sub(lambda unsafe: "".join(f"%{byte:02X}" for byte in unsafe[0].encode()), name)


def _poses(rows: pa.Table) -> pa.Table:
    """Rows of input and mirror cameras; aligned and projected cameras are in cameras.csv alone."""
    return rows.filter(pc.is_in(rows.column("role"), value_set=pa.array(["input", "mirror"])))


def _lines(rows: pa.Table, columns: Sequence[str], separator: str) -> bytes:
    """The rows as lines of UTF-8: a matrix is sixteen words, a double the shortest digits that give it back."""
    *plain, matrices = (rows.column(name).to_pylist() for name in columns)
    words = [[escaped(value) if isinstance(value, str) else repr(value) for value in column] for column in plain]
    words.append([separator.join(map(repr, T)) for T in matrices])
    return "".join(separator.join(line) + "\n" for line in zip(*words, strict=True)).encode()


SHAPES_OF_CAPTURES = """\
- reconstructed from the captures: the merged mesh with the licence in capture.json; what no view saw is missing
- boards: a rectangle, CC0-1.0"""
PAIRS = """\
View-dependent RGB-D pairs for reconstructing objects from a single view: what a camera sees, and what the camera on the
other side sees."""
ALONE = "RGB-D views of single objects, each alone on nothing, from the cameras that the job names."
SEAL = ("<!-- SHA-256 of the text above: ", " -->\n")
"""The ends of the card's last line."""


def is_card_sealed(data: bytes) -> bool:
    """Whether the bytes of a card are those that a run wrote."""
    return is_sealed(data, *SEAL)


@dataclass(frozen=True)
class MergeResult:
    """The contents of the merged dataset."""

    digest: str
    scenes: dict[str, int]
    """How many were made, and how many failed by kind."""
    rows: dict[str, int]
    """By table."""

    @property
    def complete(self) -> bool:
        """Whether `_SUCCESS` was written."""
        return not self.scenes["environmental"]


def write_card(store: Store, record: JobRecord, catalogue: "Catalogue", merged: MergeResult) -> None:
    """Writes DATASET.md."""
    fingerprint = Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE))
    store.put(README_FILE, seal(describe_dataset(record, catalogue, merged, fingerprint), *SEAL))


def describe_dataset(record: JobRecord, catalogue: "Catalogue", merged: MergeResult, fingerprint: Fingerprint) -> str:
    """The text of DATASET.md."""
    job, objects = record.job, record.job.objects_per_scene
    objects_in_each = f"{objects.low}{f' to {objects.high}' * (objects.low < objects.high)}"
    libraries = "\n".join(f"| {name} | {version} |" for name, version in sorted(fingerprint.libraries.items()))
    alone = job.scene == "studio"
    sources = "\n".join(f"- {x}" for x in describe_sources(catalogue) if not (alone and x.startswith("tables")))
    counts_of = (f"{entry.name}{'' if entry.count is None else f' ({entry.count})'}" for entry in job.cameras.more)
    more = f"| views of further cameras | {', '.join(counts_of)} |\n" if job.cameras.more else ""
    captured = job.captures is not None
    counts = ", ".join(f"{merged.scenes[outcome]} {outcome}" for outcome in ("made", "intrinsic", "environmental"))
    return f"""# {job.name}

{ALONE if alone else PAIRS} Made by Verso; the layout and the geometry follow {ARTICLE}.

| | |
|---|---|
| scenes | {job.first_scene} to {job.stop_scene - 1}: {counts} |
| pairs in each scene | {"at most " * captured}{job.pairs_per_scene} |
| objects in each scene | {"as scenes_from has them" if job.scenes_from and not alone else objects_in_each} |
| views of each pair | {", ".join(stored_roles(job))}{"" if job.render.rgb else "; without RGB"} |
{more}| seed | {job.seed} |
| dataset digest | `{merged.digest}` |
| job digest | `{record.digest}` (the job is in `{JOB_FILE}`) |
| stack's fingerprint | `{fingerprint.digest}` |
| canary scene | `{fingerprint.canary}` |
| renderer | {fingerprint.renderer} |

| library | version |
|---|---|
{libraries}

{_describe_captures(job.captures, catalogue) if job.captures is not None else ""}## Shapes

{SHAPES_OF_CAPTURES if captured else sources}

Every shape, with its licence and its split by instance, is a row of the `assets` table.

{_describe_reading(job)}"""


def _describe_reading(job: Job) -> str:
    objects = "nothing, 1 floor, 2 table, 3 and up objects"
    alpha = "Alpha is the share of a pixel that is covered; colours are not darkened by it.\n" if job.has_alpha else ""
    regions = objects if job.captures is None else "neither board nor object, 2 board, 3 object"
    return f"""## Reading it

`pyarrow.dataset.dataset("manifest/views", partitioning="hive")` has a row for each camera and the names and checksums of
its images, `manifest/objects` one for each thing that it may see; `bodies` in `manifest/scenes` says where each object lies.
{alpha}Depth is 16-bit PNG, z along the optical axis, {job.images.depth_units_per_m:g} units a metre, 0 where there is none.
Masks are 8-bit PNG: 0 {regions}. Poses are camera to world, optical frame (x right,
y down, z forward), metres.
"""


def _describe_captures(captures: Captures, catalogue: "Catalogue") -> str:
    """The section on where photographs come from and what was done to them."""
    board = captures.printed_board
    origin = f"{len(catalogue.captures)} folders of photographs with registered depth, each with the board in its board.json."
    if not captures.folders:
        shapes = "\n".join(f"- {line}" for line in describe_sources(catalogue) if not line.startswith("tables"))
        origin = f"virtual, of {captures.simulate.views} views, {board.words}, and shapes from\n\n{shapes}"
    return f"""## Captures

Each scene is a capture of one object on a board of markers; its world is the board's frame. The captures are {origin}

Poses are those of the estimate `{captures.estimation.estimate}`. Input images are the photographs without their lens, and
their depth as it was measured; where the estimate determined an offset, a scale or a registration of the depth camera, depth
is corrected by it, and drawn anew from the fitted surface where the depth camera's place is. Mirror images are made of the
{captures.synthesis.views} nearest photographs, projected images of the input's.
The column `capture` of `manifest/scenes` and `manifest/views` has residuals, what was corrected, the share that was measured,
and, for virtual captures, errors against truth.

"""


MOST_LICENCES = 10
"""Licences of a library that the card names, with how many shapes have them."""


def describe_sources(catalogue: "Catalogue") -> list[str]:
    """One line for each source of objects and of tables with its licence, and what was left out or has no colour."""
    lines = []
    for what, sources, libraries in (
        ("objects", catalogue.assets.objects, catalogue.objects),
        ("tables", catalogue.assets.tables, catalogue.tables),
    ):
        for source, library in zip(sources, libraries, strict=True):
            if isinstance(source, ProceduralSource):
                origin = f"made from seed {source.seed}, licence CC0-1.0"
            else:
                assert library is not None
                most = ", ".join(f"{name} ({count})" for name, count in library.licences.most_common(MOST_LICENCES))
                origin = f"library {source.folder}, licences {most}"
            lines.append(f"{what}, weight {source.weight:g}: {origin}")
    return [*lines, *catalogue.describe_left_out(), *catalogue.describe_plain()]

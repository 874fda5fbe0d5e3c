"""Edge: scores the items of a dataset range by range, in processes side by side, and keeps what is scored.

A range's rows are a Parquet file of SCORE/_kept, whose name is the digest of all that they follow from: the range's commit,
the predictions' bytes, what was asked, and this room's code. The same command reads it instead of scoring again.
"""

import hashlib
import json
import multiprocessing
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.errors import MachineError, plural
from services.dataset.dataset import iter_pairs
from services.dataset.shapes import RangeFiles, StoredFiles
from services.job.record import require_job
from services.run.machine import usable_cores
from services.run.progress import ProgressLine
from services.score.items import Asked, score_pair
from services.score.predictions import Key, Predictions
from workers.store.ledger import iter_committed, range_rows
from workers.store.local import open_store
from workers.store.store import Store

KEPT: Final = "_kept"
ITEMS_FILE: Final = "items.parquet"

FEW: Final = 64
"""Predictions below which no processes are started: each takes seconds to begin."""

FACTS: Final = pa.schema(
    [
        ("kind", pa.string()),
        ("pose_id", pa.int64()),
        ("scene_id", pa.int64()),
        ("category", pa.string()),
        ("instance", pa.string()),
        ("region", pa.int64()),
        ("visible_fraction", pa.float64()),
        ("diagonal_m", pa.float64()),
        ("status", pa.string()),
        ("reason", pa.string()),
    ]
)
"""The columns of items.parquet before those of metrics. Items without a pose of the dataset have null there."""


@dataclass(frozen=True)
class _Range:
    """A range to score: where its rows go, and what is predicted of it."""

    place: str
    records: Sequence[CommitRecord]
    folder: Path
    found: Mapping[Key, tuple[str, ...]]
    asked: Asked
    kept: Path


def score_dataset(store: Store, predictions: Predictions, asked: Asked, out: Path) -> Path:
    """Scores every item, and writes OUT/items.parquet, a row an item; memory does not grow with the number of items.

    Raises InputError where the dataset has not what is predicted, CorruptError where it is damaged, MachineError where a
    process is killed.
    """
    (out / KEPT).mkdir(parents=True, exist_ok=True)
    ranges = list(_ranges(store, predictions, asked, out / KEPT))
    todo = [one for one in ranges if not one.kept.exists()]
    with closing(ProgressLine(len(todo), "score", "range")) as line:
        for done, _ in enumerate(_scored(todo), 1):
            line.show(done)
    parts = [one.kept for one in ranges]
    _write_items(parts, predictions, store.name, out / ITEMS_FILE)
    for path in set((out / KEPT).iterdir()) - set(parts):
        path.unlink()
    return out / ITEMS_FILE


def _ranges(store: Store, predictions: Predictions, asked: Asked, kept: Path) -> Iterator[_Range]:
    job = require_job(store).job
    by_scene = defaultdict[int, dict[Key, tuple[str, ...]]](dict)
    for key, names in predictions.found.items():
        by_scene[key[1] // (2 * job.pairs_per_scene)][key] = names
    code = hashlib.sha256(
        b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    ).hexdigest()
    for records in iter_committed(store):
        scenes = [by_scene[one] for one in range(records[0].span.start, records[0].span.stop) if one in by_scene]
        found = {key: names for scene in scenes for key, names in scene.items()}
        files = [
            (key, names, [_digest(predictions.folder / key[0] / name) for name in names])
            for key, names in found.items()
        ]
        commits = [record.model_dump_json() for record in records]
        told = json.dumps([code, str(predictions.folder), asdict(asked), commits, files])
        digest = hashlib.sha256(told.encode()).hexdigest()[:32]
        yield _Range(store.name, records, predictions.folder, found, asked, kept / f"{digest}.parquet")


def _digest(path: Path) -> str:
    """SHA-256 of a file, empty for a line of a table, whose text is told. A clock that is set back may hide a change."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _scored(ranges: Sequence[_Range]) -> Iterator[None]:
    count = min(usable_cores(), len(ranges))
    if count < 2 or sum(len(one.found) for one in ranges) < FEW:
        yield from map(_score_range, ranges)
        return
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as pool:
        tasks = [pool.submit(_score_range, one) for one in ranges]
        try:
            for task in as_completed(tasks):
                yield task.result()
        except BrokenProcessPool as error:
            told = "perhaps for want of memory: start again, what is scored is kept"
            raise MachineError(f"a process that scores predictions was killed from outside, {told}") from error
        finally:
            pool.shutdown(cancel_futures=True)


@cache
def _files(place: str) -> StoredFiles:
    """Of a dataset, kept by the process: shapes are read once."""
    store = open_store(place)
    return StoredFiles(store, require_job(store))


def _score_range(one: _Range) -> None:
    """Writes the rows of a range, whole or not at all."""
    files = _files(one.place)
    rows: list[Row] = []
    for pair in iter_pairs(lambda table: range_rows(files.store, one.records, table), RangeFiles(files, one.records)):
        rows += score_pair(pair, one.folder, one.found, one.asked)
    partial = one.kept.with_name(f".{one.kept.name}.{os.getpid()}")
    pq.write_table(_table(rows), partial)
    os.replace(partial, one.kept)


def _table(rows: Sequence[Row]) -> pa.Table:
    metrics = sorted({name for row in rows for name in row} - set(FACTS.names))
    schema = pa.schema([*FACTS, *((name, pa.float64()) for name in metrics)])
    return pa.Table.from_pylist([{name: row.get(name) for name in schema.names} for row in rows], schema)


def _write_items(parts: Sequence[Path], predictions: Predictions, place: str, target: Path) -> None:
    """Joins the ranges' rows, with a refused row for each prediction that no pair of the dataset has."""
    unknown = set(predictions.found)
    for part in parts:
        ids = pq.read_table(part, columns=["kind", "pose_id", "region"]).to_pylist()
        unknown -= {(row["kind"], row["pose_id"], row["region"]) for row in ids}
    strays = [
        {"kind": kind, "pose_id": pose_id, "region": region, "reason": _why_unknown(pose_id, place)}
        for kind, pose_id, region in sorted(unknown)
    ]
    strays += [{"kind": kind, "reason": why} for kind, _, why in predictions.strays]
    last = _table([row | {"status": "refused"} for row in strays])
    schema = pa.unify_schemas([FACTS, *(pq.read_schema(part) for part in parts)])
    partial = target.with_name(f".{target.name}.{os.getpid()}")
    with pq.ParquetWriter(partial, schema) as file:
        for table in (*map(pq.read_table, parts), last):
            filled = [
                table[name] if name in table.column_names else pa.nulls(len(table), pa.float64())
                for name in schema.names
            ]
            file.write_table(pa.table(filled, schema))
    os.replace(partial, target)


def _why_unknown(pose_id: int, place: str) -> str:
    if pose_id % 2 == 0:
        return f"{pose_id} is the id of an input pose: predictions have that of the mirror pose, {pose_id + 1}"
    return f"{place} has no such item {pose_id}: the id is of another dataset"


def describe_refused(path: Path, most: int = 10) -> list[str]:
    """A line for each refused item of items.parquet, and then for the missing ones by kind; the first ones alone."""
    rows = pq.read_table(
        path, columns=["kind", "pose_id", "status", "reason"], filters=[("status", "!=", "ok")]
    ).to_pylist()
    ids = ["" if row["pose_id"] is None else f" {row['pose_id']:05d}" for row in rows]
    lines = [
        f"{row['kind']}{name} refused: {row['reason']}"
        for name, row in zip(ids, rows, strict=True)
        if row["status"] == "refused"
    ]
    told = [*lines[:most], *([f"and {plural(len(lines) - most, 'more item')} refused"] if len(lines) > most else [])]
    missing = defaultdict[str, list[str]](list)
    for row in rows:
        if row["status"] == "missing":
            missing[row["kind"]].append(f"{row['pose_id']:05d}")
    for kind, ids in missing.items():
        more = f" and {len(ids) - most} more" if len(ids) > most else ""
        told.append(f"{kind} missing: {', '.join(ids[:most])}{more}")
    return told

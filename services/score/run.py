"""Edge: scores the items of a dataset range by range, in processes side by side, and keeps what is scored.

What is kept of a range has the digest of all that it follows from: the range's commit, the predictions' bytes, what was asked,
and this room's code. The same command reads it instead of scoring again.
"""

import hashlib
import json
import os
import platform
import sys
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.errors import InputError, MachineError, RunError, VersoError, needs_making, plural
from schemas.job.assets import SPLITS
from schemas.job.job import Job
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import Role
from services.dataset.dataset import RangeRows, pairs_of
from services.dataset.shapes import RangeFiles, StoredFiles
from services.job.record import require_job
from services.read.query import query
from services.run.machine import usable_cores
from services.run.progress import ProgressLine
from services.score.images import require_flip
from services.score.items import Asked, score_pair
from services.score.predictions import Key, Predictions, by_export_ids, digest_of
from services.score.summary import ITEMS_FILE
from workers.store.ledger import iter_committed, range_rows
from workers.store.local import open_store
from workers.store.store import Store

if TYPE_CHECKING:
    from workers.pool import Ended

KEPT: Final = "_kept.answers"

MOST_MIB, MOST_CPU_S = 4096, 60.0
"""Limits of scoring a pose: of memory, and of processor seconds. What a stranger predicts may be made to take any of both."""

FACTS: Final = pa.schema(
    [
        ("kind", pa.string()),
        ("pose_id", pa.int64()),
        ("scene_id", pa.int64()),
        ("split", pa.string()),
        ("category", pa.string()),
        ("instance", pa.string()),
        ("region", pa.int64()),
        ("visible_fraction", pa.float64()),
        ("diagonal_m", pa.float64()),
        ("farthest_m", pa.float64()),
        ("status", pa.string()),
        ("reason", pa.string()),
    ]
)
"""The columns of items.parquet before those of metrics. Items without a pose of the dataset have null there."""


@dataclass(frozen=True)
class _Range:
    """A range to score, what is predicted of it, and the digest of all that its rows follow from.

    poses: the mirror poses that are scored. keys: of one pose, the predictions that are; empty: the items without any. None: all.
    blame: why they are refused unread.
    """

    place: str
    records: Sequence[CommitRecord]
    poses: Sequence[int]
    folder: Path
    predicted: Mapping[Key, tuple[str, ...]]
    asked: Asked
    digest: str
    keys: tuple[Key, ...] | None = None
    blame: str = ""

    @property
    def key(self) -> str:
        """The name of its rows among those that are kept."""
        return f"{self.digest} {self.poses[0]} {len(self.poses)} {self.keys} {self.blame}"

    def instead(self, end: "Ended") -> "Iterator[_Range]":
        """What is asked in place of a range that ended its process: its poses one by one, then what is predicted of one.

        A prediction that ends its process alone is refused. Raises MachineError where a pose was killed from outside.
        """
        if len(self.poses) > 1:
            yield from (replace(self, poses=(pose,)) for pose in self.poses)
        elif end.how == "killed":
            raise MachineError(f"scoring pose {self.poses[0]}: {end.detail}: start again, what is scored is kept")
        elif self.keys is None:
            each = [(key,) for key in self.predicted if key[1] in self.poses]
            yield from (replace(self, keys=keys) for keys in [(), *each])
        else:
            remedy = "" if end.how == "crashed" else ": make it smaller"
            yield replace(self, blame=f"scoring it {end.detail}{remedy}")

    def has(self, row: Row) -> bool:
        """Whether an item of its poses is to be scored."""
        key = row["kind"], row["pose_id"], row["region"]
        return self.keys is None or key in self.keys or not (self.keys or key in self.predicted)


def score_dataset(store: Store, predictions: Predictions, asked: Asked, out: Path) -> Path:
    """Scores every item, and writes OUT/items.parquet, a row an item; memory does not grow with the number of items.

    Raises InputError where the dataset has not what is predicted, CorruptError where it is damaged, RunError where it is extended
    meanwhile, MachineError where a process is killed.
    """
    if "shape" in asked.kinds:
        with needs_making("scoring shapes"):
            import services.score.shape  # noqa: F401
    if asked.flip and "rgb" in asked.kinds:
        require_flip()
    if "pose" in asked.kinds:
        role: Role = "input" if asked.frame == "input" else "mirror"
        pairs = require_job(store).job.pairs_per_scene
        predictions = by_export_ids(predictions, pairs, _scenes(store), role)
        if predictions.by_export:
            print("verso: poses.csv is read by the ids of an export (scene_id, im_id, obj_id)", file=sys.stderr)
    ranges, scored = list(_ranges(store, predictions, asked)), list[_Range]()
    todo = ranges
    poses = {pose for item in todo for pose in item.poses}
    if not any(pose in poses for _, pose, _ in predictions.names):
        examples = ", ".join(f"{kind}/{pose:05d}" for kind in predictions.kinds[:1] for pose in sorted(poses)[:3])
        raise InputError(f"{predictions.folder} has no item of {store.name}, whose names are like {examples}")
    out.mkdir(parents=True, exist_ok=True)
    unknown, metrics = set(predictions.names), set[str]()
    with closing(ProgressLine(len(todo), "score", "range")) as line:
        while todo:
            again: list[_Range] = []
            for item, answer in _answers(todo, out / KEPT):
                if not isinstance(answer, bytes):
                    again += item.instead(answer)
                    line.expect(len(scored) + len(todo) + len(again))
                    continue
                table = _table_of(item, answer)
                unknown -= {tuple(row.values()) for row in table.select(["kind", "pose_id", "region"]).to_pylist()}
                metrics |= set(table.column_names) - set(FACTS.names)
                scored.append(item)
                line.show(len(scored))
            todo = again
    before, now = [item.records for item in ranges], list(iter_committed(store))
    if before != now:
        counts = (sum(records[0].span.stop - records[0].span.start for records in each) for each in (before, now))
        scenes = "{} scenes before, {} now".format(*counts)
        raise RunError(
            f"{store.name} has changed while it was scored ({scenes}): score it again, what is scored is kept"
        )
    scored.sort(key=lambda item: item.poses[0])
    tables = (_table_of(item, answer) for item, answer in _answers(scored, out / KEPT) if isinstance(answer, bytes))
    strays = _table([*_strays(predictions, unknown, store.name)])
    _write_items((*tables, strays), metrics, out / ITEMS_FILE)
    return out / ITEMS_FILE


_INSTANCES: Final = f"""
select scene_id, coalesce([body.region_id for body in bodies], [{REGION_FIRST_OBJECT}]) as regions,
  coalesce([body.instance_id for body in bodies], [instance_id]) as instances from scenes order by 1
"""


def _scenes(store: Store) -> Iterator[tuple[int, dict[int, str]]]:
    """Each scene's id, and the instances of its objects by region."""
    for row in query(store, _INSTANCES).to_pylist():
        yield row["scene_id"], dict(zip(row["regions"], row["instances"], strict=True))


def _ranges(store: Store, predictions: Predictions, asked: Asked) -> Iterator[_Range]:
    pairs = require_job(store).job.pairs_per_scene
    by_scene = defaultdict[int, dict[Key, tuple[str, ...]]](dict)
    for key, names in predictions.names.items():
        by_scene[key[1] // (2 * pairs)][key] = names
    code = [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    code_digest = hashlib.sha256(b"".join(code)).hexdigest()
    for records in iter_committed(store):
        span = records[0].span
        predicted = {
            key: names for scene in range(span.start, span.stop) for key, names in by_scene.get(scene, {}).items()
        }
        files = [[key, [digest_of(predictions.folder, key, name) for name in predicted[key]]] for key in predicted]
        commits = [record.model_dump_json() for record in records]
        what = json.dumps([code_digest, str(predictions.folder), asdict(asked), commits, files])
        poses = range(2 * pairs * span.start + 1, 2 * pairs * span.stop, 2)
        digest = hashlib.sha256(what.encode()).hexdigest()
        yield _Range(store.name, records, poses, predictions.folder, predicted, asked, digest)


def _answers(ranges: Sequence[_Range], kept: Path) -> "Iterator[tuple[_Range, bytes | Ended]]":
    """Each range with its packed rows; away from Linux one after another, and none kept."""
    if platform.system() != "Linux":
        yield from ((item, _score_range(item)) for item in ranges)
        return
    from workers.pool import Answers, Limits, run_pool

    cpu_s = MOST_CPU_S * max((len(item.poses) for item in ranges), default=1)
    limits = Limits(MOST_MIB, cpu_s, 10.0 * cpu_s)  # by the clock too: without memory, libraries may wait for ever
    kept_answers, cores = Answers(kept), usable_cores()
    yield from run_pool(
        _score_range, ranges, key=attrgetter("key"), kept=kept_answers, limits=limits, processes=cores, quiet=False
    )


def _score_range(item: _Range) -> bytes:
    """A range's rows as an Arrow stream; empty where the dataset is damaged, which the process that asks finds again."""
    try:
        table = _table(_rows(item))
    except VersoError:
        return b""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return bytes(sink.getvalue())


def _table_of(item: _Range, answer: bytes) -> pa.Table:
    return pa.ipc.open_stream(answer).read_all() if answer else _table(_rows(item))


@cache
def _files(place: str) -> tuple[StoredFiles, Job]:
    """Of a dataset, and its job, kept by the process: shapes are read once."""
    store = open_store(place)
    record = require_job(store)
    return StoredFiles(store, record), record.job


def _rows(item: _Range) -> list[Row]:
    files, job = _files(item.place)
    stored = RangeRows.of(lambda table: range_rows(files.store, item.records, table))
    predicted = item.predicted if item.keys is None else {key: item.predicted[key] for key in item.keys}
    rows: list[Row] = []
    for pair in pairs_of(stored, RangeFiles(files, item.records)):
        if pair.mirror is None or pair.mirror.pose_id in item.poses:
            rows += score_pair(pair, item.folder, predicted, item.asked, job, item.blame)
    return list(filter(item.has, rows))


def _table(rows: Sequence[Row]) -> pa.Table:
    """nan is null: to whoever asks of the file, both are no value."""
    schema = _schema({name for row in rows for name in row} - set(FACTS.names))
    return pa.table(
        [
            pa.array([row.get(name) for row in rows], kind, from_pandas=True)
            for name, kind in zip(schema.names, schema.types, strict=True)
        ],
        schema,
    )


def _schema(metrics: Collection[str]) -> pa.Schema:
    return pa.schema([*FACTS, *((name, pa.float64()) for name in sorted(metrics))])


def _write_items(tables: Iterable[pa.Table], metrics: Collection[str], target: Path) -> None:
    """Joins tables into one with all columns, whole or not at all."""
    schema, partial = _schema(metrics), target.with_name(f".{target.name}.{os.getpid()}")
    with pq.ParquetWriter(partial, schema) as file:
        for table in tables:
            file.write_table(pa.concat_tables([schema.empty_table(), table], promote_options="default"))
    os.replace(partial, target)


def _strays(predictions: Predictions, unknown: Collection[Key], place: str) -> Iterator[Row]:
    """A row for each prediction that no pair of the dataset has."""
    for kind, pose_id, region in sorted(unknown):
        why = f"{place} has no such item {pose_id}: the id is of another dataset"
        if pose_id % 2 == 0:
            why = f"{pose_id} is the id of an input pose: predictions have that of the mirror pose, {pose_id + 1}"
        yield {"kind": kind, "pose_id": pose_id, "region": region, "status": "unknown", "reason": why}
    for kind, why in predictions.strays:
        yield {"kind": kind, "status": "unknown", "reason": why}


def describe_refused(path: Path, most: int = 10) -> list[str]:
    """A line for each refused or unknown item of items.parquet, and then for the missing ones by kind; the first ones alone."""
    names = ["kind", "pose_id", "split", "status", "reason"]
    rows = pq.read_table(path, columns=names).to_pylist()
    refused = [row for row in rows if row["status"] in ("refused", "unknown")]
    lines = []
    for row in refused[:most]:
        pose = "" if row["pose_id"] is None else f" {row['pose_id']:05d}"
        lines.append(f"{row['kind']}{pose} refused: {row['reason']}")
    if len(refused) > most:
        lines.append(f"and {plural(len(refused) - most, 'more item')} refused")
    splits, others = ({row["split"] for row in rows if row["status"] == status} for status in ("ok", "missing"))
    if len(splits) == 1 and others - splits and splits <= {*SPLITS}:
        lines.append(f"all that is predicted is of one split: score that alone with --split {splits.pop()}")
    if outside := sum(row["status"] == "outside" for row in rows):
        lines.append(f"{plural(outside, 'prediction')} of other splits or levels not scored")
    missing = defaultdict[str, list[str]](list)
    for row in rows:
        if row["status"] == "missing":
            missing[row["kind"]].append(f"{row['pose_id']:05d}")
    for kind, ids in missing.items():
        more = f" and {len(ids) - most} more" if len(ids) > most else ""
        lines.append(f"{kind} missing: {', '.join(ids[:most])}{more}")
    return lines

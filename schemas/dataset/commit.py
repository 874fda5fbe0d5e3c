"""Commits: the record that a range of scenes is done, and the ledger of all records."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, StringConstraints, model_validator

from schemas.base import Frozen, NonNegativeInt, PositiveInt
from schemas.dataset.layout import MAX_RETRIES, MAX_SCENE, is_attempt_name, is_plain_path, is_range_file, pose_of_image
from schemas.errors import FailureKind

Outcome = Literal["made", "intrinsic", "environmental"]
"""The outcome of a scene: made, or the kind of its failure."""

COMMIT_VERSION = 1
"""Of the records that this program writes."""

_Digest = Annotated[str, StringConstraints(pattern=r"^[ -~]{0,128}$")]
_SceneId = Annotated[int, Field(ge=0, le=MAX_SCENE)]


class Span(Frozen):
    """The scenes of one commit: all of [start, stop), or those of `scenes` in a retry."""

    start: _SceneId
    stop: _SceneId
    retry: Annotated[int, Field(ge=0, lt=MAX_RETRIES)] = 0
    """0 for the range itself, k for the k-th retry of its environmental failures."""
    scenes: tuple[int, ...] = ()
    """The scenes of a retry, in order; empty for a whole range."""

    @property
    def scene_ids(self) -> tuple[int, ...]:
        """Every scene of this commit, in order."""
        return self.scenes if self.retry else tuple(range(self.start, self.stop))

    @property
    def count(self) -> int:
        """Number of scenes of this commit."""
        return len(self.scenes) if self.retry else self.stop - self.start

    @model_validator(mode="after")
    def _check(self) -> "Span":
        bounds = (self.start - 1, *self.scenes, self.stop)
        if any(b <= a for a, b in pairwise(bounds)) or bool(self.scenes) != bool(self.retry) or self.stop <= self.start:
            raise ValueError("scenes must rise from start to stop, and be named in a retry alone")
        return self


class CommitTerms(Frozen):
    """The settings that all commits of a dataset share; stored in every record."""

    job_digest: _Digest
    fingerprint: _Digest
    """Of the stack that made the range."""
    fingerprint_mode: Literal["strict", "record"] = "strict"
    layout: Literal["files", "tar"] = "files"
    first_scene: NonNegativeInt = 0
    """Start of the first range; ranges lie on a grid of `range_size`."""
    range_size: PositiveInt = 16
    pairs_per_scene: PositiveInt


class FileEntry(Frozen):
    """A published file: its path below the output folder, its size and its SHA-256 in hex."""

    path: str
    bytes: NonNegativeInt
    sha256: str


MARK = 16
"""Characters of a scene's digest that are kept and compared."""


class SceneMark(Frozen):
    """The outcome of a scene, and the digest of its rows in every deterministic table but assets.

    Rows of `views` hold the digest of every image: two attempts made the same bytes if and only if their marks are equal.
    """

    scene_id: NonNegativeInt
    outcome: Outcome
    digest: str
    """The first `MARK` characters, in hex."""
    reason: str | None = None
    """Of the failure; None where the scene was made."""

    @model_validator(mode="after")
    def _check(self) -> "SceneMark":
        if (self.outcome == "made") != (self.reason is None):
            raise ValueError(f"scene {self.scene_id} must have a reason if and only if it failed")
        return self


class CommitRecord(Frozen):
    """`manifest/_commits/<start>.json`: the decision which attempt is this range.

    Unknown keys, of a later minor version, are ignored; the reader refuses a later `schema_version`.
    """

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    kind: Literal["verso-commit"] = "verso-commit"
    schema_version: PositiveInt
    span: Span
    attempt: str
    terms: CommitTerms
    files: tuple[FileEntry, ...]
    """The range's tables and tars, sorted by path; the tables name images and shapes (`committed_files` has them all)."""
    tables: dict[str, NonNegativeInt]
    """Number of rows, by table."""
    scenes: tuple[SceneMark, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check(self) -> "CommitRecord":
        span = self.span
        if not is_attempt_name(self.attempt, span.retry):
            raise ValueError(f"{self.attempt!r} is not the name of an attempt")
        if len(self.scenes) != span.count or any(
            mark.scene_id != scene for mark, scene in zip(self.scenes, span.scene_ids, strict=True)
        ):
            raise ValueError("the scenes are not those of the range")
        if (foreign := foreign_path(self.files, span, self.terms.pairs_per_scene)) is not None:
            raise ValueError(f"{foreign!r} is not a file of the range from scene {span.start}")
        return self


def foreign_path(files: Iterable[FileEntry], span: Span, pairs: int) -> str | None:
    """A path that no commit of this span may name, None where all are its own.

    Names of images must be of poses of the span's scenes: with p pairs in a scene, pose k belongs to scene k // 2p.
    """
    for entry in files:
        pose = pose_of_image(entry.path)
        of_scene = pose is not None and span.start <= pose // (2 * pairs) < span.stop
        of_range = pose is None and is_range_file(entry.path, span.start, span.retry)
        if not (of_scene or of_range) or not is_plain_path(entry.path):
            return entry.path
    return None


@dataclass(frozen=True)
class CommitResult:
    """The result of an attempt: whether it won, the record that is valid, and how the bytes of a loser differ."""

    won: bool
    record: CommitRecord
    conflict: str | None = None


@dataclass(frozen=True)
class CommitSummary:
    """The part of a record that planning needs; small enough for a million scenes in memory."""

    start: int
    stop: int
    retry: int
    made: int
    failed: tuple[tuple[int, FailureKind, str], ...]
    """(scene id, kind, reason), in order."""
    scenes: tuple[int, ...] = ()
    """The scenes of a retry; empty for a whole range."""
    fingerprint: str = ""
    job_digest: str = ""


def summarize(record: CommitRecord) -> CommitSummary:
    """The part of the record that planning needs."""
    span, terms = record.span, record.terms
    failed = tuple((one.scene_id, one.outcome, one.reason or "") for one in record.scenes if one.outcome != "made")
    counts = (span.start, span.stop, span.retry, span.count - len(failed))
    return CommitSummary(*counts, failed, span.scenes, terms.fingerprint, terms.job_digest)


def _fields(**kinds: pa.DataType) -> list[pa.Field]:
    return [pa.field(name, kind, nullable=False) for name, kind in kinds.items()]


_FAILURE = pa.struct(_fields(scene_id=pa.int64(), kind=pa.string(), reason=pa.string()))
_NAME = pa.dictionary(pa.int32(), pa.string())

LEDGER_SCHEMA = pa.schema(
    [
        *_fields(start=pa.int64(), stop=pa.int64(), retry=pa.int32(), made=pa.int32(), failed=pa.list_(_FAILURE)),
        *_fields(scenes=pa.list_(pa.int64()), fingerprint=_NAME, job_digest=_NAME),
    ]
)
"""Fields of `CommitSummary`."""


def rows_of(summaries: Iterable[CommitSummary]) -> pa.Table:
    """A row of `LEDGER_SCHEMA` for each."""
    keys = ("scene_id", "kind", "reason")
    rows = [
        {**vars(one), "failed": [dict(zip(keys, failure, strict=True)) for failure in one.failed]} for one in summaries
    ]
    return pa.Table.from_pylist(rows, LEDGER_SCHEMA)


def join_rows(parts: Iterable[pa.Table]) -> pa.Table:
    """All rows, by start and retry, each commit once."""
    rows = pa.concat_tables([LEDGER_SCHEMA.empty_table(), *parts]).unify_dictionaries().combine_chunks()
    rows = rows.sort_by([("start", "ascending"), ("retry", "ascending")])
    start, retry = rows.column("start").to_numpy(), rows.column("retry").to_numpy()
    repeated = (start[1:] == start[:-1]) & (retry[1:] == retry[:-1])
    return rows.filter(pa.array(np.append(True, ~repeated))) if repeated.any() else rows


@dataclass(frozen=True)
class Ledger:
    """Every commit of a dataset, by start and retry."""

    rows: pa.Table
    """Of `LEDGER_SCHEMA`."""
    lost: tuple[tuple[int, int], ...] = ()
    """(start, retry) of commits that were there once and are not any more."""
    unkept: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """[U] rows that were read from records, because the kept summary lacks them."""

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """[N] first scene of each commit's range."""
        return self.rows.column("start").to_numpy()

    @cached_property
    def stop(self) -> NDArray[np.int64]:
        """[N] end of each commit's range."""
        return self.rows.column("stop").to_numpy()

    @cached_property
    def retry(self) -> NDArray[np.int32]:
        """[N] 0 for the range itself, k for its k-th retry."""
        return self.rows.column("retry").to_numpy()

    def count(self, row: int) -> int:
        """Number of scenes of one commit."""
        again = len(self.rows.column("scenes")[row])
        return again or int(self.stop[row] - self.start[row])

    @property
    def ranges(self) -> NDArray[np.int64]:
        """[R, 2] start and stop of every committed range, in order."""
        whole = self.retry == 0
        return np.stack([self.start[whole], self.stop[whole]], axis=1)

    @property
    def committed(self) -> int:
        """Number of scenes in committed ranges."""
        whole = self.retry == 0
        return int((self.stop[whole] - self.start[whole]).sum())

    @cached_property
    def failures(self) -> pa.Table:
        """Failures that no retry made good: columns start, scene_id, kind and reason, in order of the scenes."""
        failed, row = self._flat("failed")
        table = pa.table({name: pc.struct_field(failed, name) for name in ("scene_id", "kind", "reason")})
        scene = table.column("scene_id").to_numpy()
        again, of = self._flat("scenes")
        last = dict(zip(again.to_pylist(), self.retry[of].tolist(), strict=True))  # later retries come later
        stands = np.array([last.get(one, 0) for one in scene.tolist()], np.int32) == self.retry[row]
        table = table.append_column("start", pa.array(self.start[row])).filter(pa.array(stands))
        return table.sort_by([("scene_id", "ascending")])

    @property
    def fingerprints(self) -> list[str]:
        """The stacks that made the commits, sorted."""
        return sorted(pc.unique(self.rows.column("fingerprint")).to_pylist())

    def _flat(self, name: str) -> tuple[pa.Array, NDArray[np.int64]]:
        """The items of a list column, and the row of each."""
        lists = self.rows.column(name).combine_chunks()
        lists = lists.combine_chunks() if isinstance(lists, pa.ChunkedArray) else lists
        lengths = pc.fill_null(pc.list_value_length(lists), 0).to_numpy(zero_copy_only=False)
        return lists.flatten(), np.repeat(np.arange(len(lengths)), lengths)

"""A commit: the record that a range of scenes is done, and the terms that all commits of a dataset share."""

from dataclasses import dataclass
from typing import Literal

from pydantic import ConfigDict, Field

from schemas.base import Frozen, NonNegativeInt, PositiveInt
from schemas.errors import FailureKind

Outcome = Literal["made", "intrinsic", "environmental"]
"""The outcome of a scene: made, or the kind of its failure."""


class Span(Frozen):
    """The scenes of one commit: all of [start, stop), or those of `scenes` in a retry."""

    start: NonNegativeInt
    stop: PositiveInt
    retry: NonNegativeInt = 0
    """0 for the range itself, k for the k-th retry of its environmental failures."""
    scenes: tuple[int, ...] = ()
    """The scenes of a retry, in order; empty for a whole range."""

    @property
    def scene_ids(self) -> tuple[int, ...]:
        """Every scene of this commit, in order."""
        return self.scenes if self.retry else tuple(range(self.start, self.stop))


class CommitTerms(Frozen):
    """The settings that all commits of a dataset share; stored in every record."""

    job_digest: str
    fingerprint: str
    """Of the stack that made the range."""
    fingerprint_mode: Literal["strict", "record"] = "strict"
    layout: Literal["files", "tar"] = "files"
    first_scene: NonNegativeInt = 0
    """Start of the first range; ranges lie on a grid of `range_size`."""
    range_size: PositiveInt = 16


class FileEntry(Frozen):
    """A published file: its path below the output folder, its size and its SHA-256 in hex."""

    path: str
    bytes: NonNegativeInt
    sha256: str


class TableEntry(Frozen):
    """A table of the range: its rows and the digest of its canonical rows."""

    rows: NonNegativeInt
    digest: str


class SceneMark(Frozen):
    """The outcome of a scene, and the digest of its rows in every deterministic table but assets.

    Rows of `views` hold the digest of every image: two attempts made the same bytes if and only if their marks are equal.
    """

    scene_id: NonNegativeInt
    outcome: Outcome
    digest: str


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
    """Images (or tars), shapes and the range's tables, sorted by path."""
    tables: dict[str, TableEntry]
    scenes: tuple[SceneMark, ...] = Field(min_length=1)


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
    failed: tuple[tuple[int, FailureKind], ...]
    """(scene id, kind), in order."""
    scenes: tuple[int, ...] = ()
    """The scenes of a retry; empty for a whole range."""

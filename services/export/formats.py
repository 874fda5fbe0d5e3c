"""What an export is: its request and choice of scenes, and what every format has.

- Which scenes of a dataset are exported: by id, by category, and by an SQL condition.
- What an export is asked for: a dataset, a place, a format by name, and a choice of scenes.
- What every format is: a writer that takes scenes in order and says which pairs it leaves out, and why.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import duckdb

from schemas.base import Frozen
from schemas.dataset.tables import SCHEMAS
from schemas.errors import InputError
from services.export.folder import ExportFolder
from services.export.source import ExportScene
from services.export.table import FORMATS
from services.job.record import JobRecord
from services.read.dataset_reader import StoredRange
from workers.store.manifest import table_of_rows
from workers.store.store import Store

_TABLES = ("scenes", "views", "objects", "assets")
_LOCKED = {
    "enable_external_access": "false",
    "python_enable_replacements": "false",
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "threads": "1",
}
"""The condition sees the tables of a range and no file, no network, no variable of this process."""


class Choice(Frozen):
    """What a user asked for; by default every scene that was made."""

    categories: tuple[str, ...] = ()
    """Of the scene, which is that of its first object; none: all."""
    first_scene: int | None = None
    last_scene: int | None = None
    """Included."""
    where: str | None = None
    """An SQL condition on the columns of `scenes`; subqueries may ask the other tables about the same scene."""


EVERYTHING: Final = Choice()
_EXAMPLE: Final = "it is an SQL condition on the columns of scenes, such as 'support_margin_mm > 5'"


class Chooser:
    """Chooses scenes range by range."""

    def __init__(self, choice: Choice) -> None:
        """Raises InputError where the condition is no SQL that these tables can answer."""
        self._choice = choice
        self._db = duckdb.connect(":memory:", config=dict(_LOCKED))
        if choice.where is not None:
            self._ask({table: SCHEMAS[table].empty_table() for table in _TABLES})

    def choose(self, stored: StoredRange) -> Sequence[int]:
        """The ids of the chosen scenes of a range, in order."""
        choice, rows = self._choice, stored.rows["scenes"]
        low, high = choice.first_scene or 0, choice.last_scene
        ids = [
            int(row["scene_id"])
            for row in rows
            if (not choice.categories or row["category"] in choice.categories)
            and low <= row["scene_id"]
            and (high is None or row["scene_id"] <= high)
        ]
        if choice.where is None or not ids:
            return ids
        fit = self._ask(
            {table: table_of_rows(table, stored.rows[table]).select(names) for table, names in self._names()}
        )
        return [scene_id for scene_id in ids if scene_id in fit]

    def _names(self) -> list[tuple[str, list[str]]]:
        return [(table, SCHEMAS[table].names) for table in _TABLES]

    def _ask(self, tables: dict) -> set[int]:
        """The ids of the scenes in `tables` that the condition holds for."""
        for name, table in tables.items():
            self._db.register(name, table)
        try:
            found = self._db.execute(f"SELECT scene_id FROM scenes WHERE ({self._choice.where}\n)").fetchall()
        except duckdb.Error as error:
            line = str(error).splitlines()[0]
            told = f"--where {self._choice.where!r} cannot be asked: {line}"
            raise InputError(f"{told}; {_EXAMPLE}") from error
        return {scene_id for (scene_id,) in found}


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """What to export, where to, and how."""

    store: Store
    target: Path
    format: str
    """A key of `services.export.table.FORMATS`."""
    choice: Choice = EVERYTHING
    shard_mb: int = 256
    """Size that ends a shard, of formats that have shards; 10^6 bytes."""

    @property
    def most_bytes(self) -> int:
        """The same in bytes."""
        return 1_000_000 * self.shard_mb


@dataclass(frozen=True)
class LeftOut:
    """A pair that a format cannot hold."""

    scene_id: int
    pose_id: int
    reason: str
    """The same words for every pair of a kind."""


@dataclass(frozen=True)
class Added:
    """What became of a scene."""

    pairs: int
    """How many of its pairs were written."""
    left_out: tuple[LeftOut, ...] = ()


class Writer(Protocol):
    """Writes one format into an `ExportFolder`."""

    def add(self, scene: ExportScene) -> Added:
        """Takes the next scene."""

    def state(self) -> dict[str, Any] | None:
        """What a new writer must know to go on from here; None while something that it took is not whole in the folder."""

    def finish(self) -> None:
        """Writes what is still waiting. Afterwards `state` is not None."""

    def describe(self) -> dict[str, Any]:
        """What the manifest says of this format: units, frames, counts."""

    def close(self) -> None:
        """Lets go of what is open; what is not in the last state may be lost."""


def open_writer(
    name: str, request: ExportRequest, record: JobRecord, folder: ExportFolder, state: dict[str, Any] | None
) -> Writer:
    """The writer of a format; `state` is what it said at the last checkpoint, None where it begins."""
    writer: Writer = FORMATS[name].load()(request, record, folder, state)
    return writer

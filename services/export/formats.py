"""What is asked of an export (a dataset, a place, a format, a choice of scenes), and what a writer of a format has."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import duckdb

from schemas.base import Frozen
from schemas.dataset.tables import SCHEMAS
from schemas.errors import InputError
from services.export.folder import ExportFolder, Rounds
from services.export.source import ExportScene
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
        choice, rows = self._choice, stored.rows
        low, high = choice.first_scene or 0, choice.last_scene
        ids = [
            int(row["scene_id"])
            for row in rows["scenes"]
            if (not choice.categories or row["category"] in choice.categories)
            and low <= row["scene_id"]
            and (high is None or row["scene_id"] <= high)
        ]
        if choice.where is None or not ids:
            return ids
        fit = self._ask({table: table_of_rows(table, rows[table]).select(SCHEMAS[table].names) for table in _TABLES})
        return [scene_id for scene_id in ids if scene_id in fit]

    def _ask(self, tables: dict) -> set[int]:
        """The ids of the scenes in `tables` that the condition holds for."""
        for name, table in tables.items():
            self._db.register(name, table)
        try:
            found = self._db.execute(f"SELECT scene_id FROM scenes WHERE ({self._choice.where}\n)").fetchall()
        except duckdb.Error as error:
            line = str(error).splitlines()[0]
            raise InputError(f"--where {self._choice.where!r} cannot be asked: {line}; {_EXAMPLE}") from error
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


@dataclass(frozen=True)
class Added:
    """What became of a scene: how many of its pairs were written, and (pose id, reason) of those that were left out.

    A reason is the same words for every pair of a kind.
    """

    pairs: int
    left_out: tuple[tuple[int, str], ...] = ()


class Writer:
    """Writes one format into an `ExportFolder`.

    `kept` is what a new writer must know to go on from here, as JSON holds it; FRESH is that of the beginning.
    """

    FRESH: ClassVar[dict[str, Any]]

    def __init__(
        self, request: ExportRequest, record: JobRecord, folder: ExportFolder, kept: dict[str, Any] | None
    ) -> None:
        self.store, self.record, self.folder = request.store, record, folder
        self.kept = copy.deepcopy(self.FRESH) if kept is None else kept
        self.begin(request, fresh=kept is None)

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Opens what the writer needs."""

    def add(self, scene: ExportScene) -> Added:
        """Takes the next scene."""
        raise NotImplementedError

    def state(self) -> dict[str, Any] | None:
        """`kept`; None while something that the writer took is not whole in the folder."""
        return self.kept

    def finish(self) -> None:
        """Writes what is still waiting. Afterwards `state` is not None."""

    def describe(self) -> dict[str, Any]:
        """What the manifest says of this format: units, frames, counts."""
        raise NotImplementedError

    def close(self) -> None:
        """Lets go of what is open; what is not in the last state may be lost."""

    def count(self, name: str, key: str, more: int) -> None:
        """Adds to the count of `key` in `kept[name]`."""
        self.kept[name][key] = self.kept[name].get(key, 0) + more


OF_SCENE: Final = ("scene_id", "category", "instance_id", "source", "table_id", "T_world_obj", "T_world_table")
"""Columns of `scenes` that a pair in a shared file has."""


class ShardedWriter(Writer):
    """A format whose pairs share files, `rounds`, by split."""

    PATTERN: ClassVar[str]
    """The name of a file, with places for `split` and `number`."""
    rounds: Rounds

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Goes on behind the last files that were ended."""
        most_bytes = 1_000_000 * request.shard_mb
        self.rounds = Rounds(self.folder, self.open_shard, self.PATTERN, most_bytes, self.kept["rounds"])

    def open_shard(self, path: Path) -> Any:
        """A file with `add`, `bytes` and `close`."""
        raise NotImplementedError

    def state(self) -> dict[str, Any] | None:
        """None within a round."""
        rounds = self.rounds.state()
        return None if rounds is None else {**self.kept, "rounds": rounds}

    def finish(self) -> None:
        """Ends the last files."""
        self.rounds.end()

    def close(self) -> None:
        """Closes open files."""
        self.rounds.close()

    def conventions(self, depth: str) -> dict[str, Any]:
        """What the manifest says of every such format; `depth` describes the encoding of depth."""
        return {
            "not_exported": ["patches, shapes of objects, the quality figures of scenes"],
            "depth": f"{depth}, z along the optical axis; divide by depth_units_per_m for metres, 0 is no depth",
            "poses": "T_world_cam camera to world, T_cam_obj object to camera; metres, optical frame, row-major 4 x 4",
            "pixels": "cx, cy have pixel centres at +0.5; cx_opencv, cy_opencv on integers",
        }

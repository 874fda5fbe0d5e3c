"""Which scenes of a dataset are exported: by id, by category, and by an SQL condition."""

from collections.abc import Sequence
from typing import Final

import duckdb

from schemas.base import Frozen
from schemas.dataset.tables import CAPTURE_SCHEMAS, SCHEMAS
from schemas.errors import InputError
from services.read.dataset_reader import StoredRange
from workers.store.manifest import table_of_rows

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

    def __init__(self, choice: Choice, captures: bool) -> None:
        """Raises InputError where the condition is no SQL that these tables can answer."""
        self._choice = choice
        self._schemas = CAPTURE_SCHEMAS if captures else SCHEMAS
        self._db = duckdb.connect(":memory:", config=dict(_LOCKED))
        if choice.where is not None:
            self._ask({table: self._schemas[table].empty_table() for table in _TABLES})

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
        return [(table, self._schemas[table].names) for table in _TABLES]

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

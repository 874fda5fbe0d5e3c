"""What the rows and files of one scene must say before an attempt takes them."""

import json
import re
from collections.abc import Mapping

import pyarrow as pa

from schemas.commit import FileEntry, Outcome
from schemas.layout import ASSETS
from schemas.manifest import DETERMINISTIC_TABLES
from schemas.scene import SceneOutput
from workers.store.canonical import joint_digest, rows_digest
from workers.store.manifest import sorted_rows

_UNSAFE = re.compile(r"[\x00-\x1f\x7f\\]")


def outcome_of(scene_id: int, tables: Mapping[str, pa.Table]) -> Outcome:
    """How the scene ended. Raises ValueError unless its rows say exactly one thing, about this scene only."""
    for table, rows in tables.items():
        if "scene_id" in rows.column_names and set(rows.column("scene_id").to_pylist()) - {scene_id}:
            raise ValueError(f"scene {scene_id} has rows of another scene in {table}")
    made, failed = tables["scenes"].num_rows, tables["failures"].num_rows
    if made + failed != 1 or tables["timings"].num_rows > 1:
        raise ValueError(
            f"scene {scene_id} has {made} rows in scenes and {failed} in failures, and must have one in all"
        )
    if made:
        return "made"
    if extra := [table for table in ("views", "objects", "assets") if tables[table].num_rows]:
        raise ValueError(f"scene {scene_id} failed and has rows in {', '.join(extra)}")
    kind = tables["failures"].column("kind")[0].as_py()
    if kind not in ("intrinsic", "environmental"):
        raise ValueError(f"scene {scene_id} failed with the unknown kind {kind!r}")
    return kind


def check_files(output: SceneOutput, views: pa.Table, entries: Mapping[str, FileEntry]) -> None:
    """Raises ValueError unless the rows of `views` and the files agree: paths, sizes, digests, each path once."""
    if len(entries) != len(output.files):
        raise ValueError(f"scene {output.scene_id} writes a path twice")
    for path in entries:
        if _UNSAFE.search(path) or any(part in ("", ".", "..") for part in path.split("/")) or path[0] in "_.":
            raise ValueError(f"{path!r} is not a path that a scene may write")
    named = [file for files in views.column("files").to_pylist() for file in files]
    images = {path: entry.model_dump() for path, entry in entries.items() if not path.startswith(f"{ASSETS}/")}
    if len({file["path"] for file in named}) != len(named) or {file["path"]: file for file in named} != images:
        wrong = sorted({file["path"] for file in named}.symmetric_difference(images)) or [
            "sizes, digests or repetitions"
        ]
        raise ValueError(f"scene {output.scene_id}: files and the rows of views disagree about {', '.join(wrong[:5])}")


def distinct_assets(table: str, rows: pa.Table) -> pa.Table:
    """Rows of `assets` once each, where scenes share them; other tables as they are.

    Two rows of one asset that differ stay, and are refused as a repeated key.
    """
    if table != "assets" or rows.num_rows < 2:
        return rows
    seen: dict[str, int] = {}
    for index, row in enumerate(rows.to_pylist()):
        seen.setdefault(json.dumps(row), index)
    return rows.take(list(seen.values()))


def scene_digest(tables: Mapping[str, pa.Table]) -> str:
    """64 hex characters: of all that job and seed determine in a scene's rows, but for its assets."""
    names = [table for table in DETERMINISTIC_TABLES if table != "assets" and tables[table].num_rows]
    return joint_digest([(table, rows_digest(table, sorted_rows(table, tables[table]))) for table in names])

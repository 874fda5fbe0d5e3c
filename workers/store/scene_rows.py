"""Checks of one scene's rows and files before an attempt accepts them."""

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import pyarrow as pa

from schemas.dataset.commit import FileEntry, Outcome
from schemas.dataset.layout import is_shape
from schemas.dataset.tables import DETERMINISTIC_TABLES, SORT_KEYS
from schemas.scene.scene import SceneOutput

_UNSAFE = re.compile(r"[\x00-\x1f\x7f\\]")


def outcome_of(output: SceneOutput) -> Outcome:
    """How the scene ended. Raises ValueError unless its rows give exactly one outcome, of this scene alone."""
    scene_id, tables = output.scene_id, output.rows
    for table, rows in tables.items():
        if any(row.get("scene_id", scene_id) != scene_id for row in rows):
            raise ValueError(f"scene {scene_id} has rows of another scene in {table}")
    made, failed, timed = (len(tables.get(table, ())) for table in ("scenes", "failures", "timings"))
    if made + failed != 1 or timed > 1:
        raise ValueError(
            f"scene {scene_id} has {made} rows in scenes and {failed} in failures, and must have one in all"
        )
    if made:
        return "made"
    if extra := [table for table in ("views", "objects", "assets") if tables.get(table)]:
        raise ValueError(f"scene {scene_id} failed and has rows in {', '.join(extra)}")
    kind = tables["failures"][0]["kind"]
    if kind not in ("intrinsic", "environmental"):
        raise ValueError(f"scene {scene_id} failed with the unknown kind {kind!r}")
    return kind


def check_files(output: SceneOutput, entries: Mapping[str, FileEntry]) -> None:
    """Raises ValueError unless the rows of `views` and the files agree: paths, sizes, digests, each path once."""
    if len(entries) != len(output.files):
        raise ValueError(f"scene {output.scene_id} writes a path twice")
    for path in entries:
        if _UNSAFE.search(path) or any(part in ("", ".", "..") for part in path.split("/")) or path[0] in "_.":
            raise ValueError(f"{path!r} is not a path that a scene may write")
    views = cast(Sequence[Mapping[str, Any]], output.rows.get("views", ()))
    listed = [(file["path"], file["bytes"], file["sha256"]) for view in views for file in view["files"]]
    images = {(path, entry.bytes, entry.sha256) for path, entry in entries.items() if not is_shape(path)}
    if len(listed) != len(images) or set(listed) != images:
        paths = {path for path, _, _ in listed}.symmetric_difference(path for path, _, _ in images)
        wrong = sorted(paths) or ["sizes, digests or repetitions"]
        raise ValueError(f"scene {output.scene_id}: files and the rows of views disagree about {', '.join(wrong[:5])}")


def distinct_assets(table: str, rows: pa.Table) -> pa.Table:
    """Rows of `assets` without repetitions, which scenes that share a shape make; other tables as they are.

    Two different rows of one asset stay, and are refused later as a repeated key.
    """
    if table != "assets" or rows.num_rows < 2:
        return rows
    seen: dict[str, int] = {}
    for index, row in enumerate(rows.to_pylist()):
        seen.setdefault(json.dumps(row), index)
    return rows.take(list(seen.values()))


def scene_digest(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """64 hex characters: the digest of a scene's rows in the deterministic tables, except `assets`.

    SHA-256 of canonical JSON, in which a double has the shortest digits that give it back. It is only compared with
    another attempt at the same scene, and costs a tenth of the columns' digest.
    """
    tables = {
        table: sorted(rows[table], key=lambda row, names=SORT_KEYS[table]: [row[name] for name in names])  # type: ignore[misc]
        for table in DETERMINISTIC_TABLES
        if table != "assets" and rows.get(table)
    }
    text = json.dumps(tables, sort_keys=True, separators=(",", ":"), allow_nan=False, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(number: np.generic) -> Any:
    """A numpy number as a Python number."""
    return number.item()

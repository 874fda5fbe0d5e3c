"""The files of a study: two Parquet tables, and the whole study as JSON."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from services.study.errors import ERRORS
from services.study.model import Row, Study

STUDY_FILE = "study.json"
WIDE_FILE = "tradeoff.parquet"
LONG_FILE = "errors.parquet"

STUDY_VERSION = 1
"""The version of the JSON file's format."""

_SETTING = [("setting", pa.string()), ("knob", pa.string()), ("value", pa.string())]
_COST = ("ms", "ratio", "ratio_least", "ratio_most", "kilobytes", "failed_share")

LONG_SCHEMA = pa.schema(
    [
        *_SETTING,
        ("error", pa.string()),
        ("unit", pa.string()),
        ("group", pa.string()),
        *((name, pa.float64()) for name in ("ms", "ratio", "amount", "low", "high", "median")),
        ("scenes", pa.int64()),
    ]
)


def wide_schema() -> pa.Schema:
    """The schema of `tradeoff.parquet`: one row for each setting; an error and its interval are null where not measured."""
    names = sorted(ERRORS, key=lambda name: name in _COST)  # those with a column among the costs last
    figures = [f"{name}{end}" for name in names for end in ("", "_low", "_high") if f"{name}{end}" not in _COST]
    numbers = [(name, pa.float64()) for name in (*_COST, *figures)]
    return pa.schema([*_SETTING, ("changes", pa.string()), *numbers, ("notes", pa.list_(pa.string()))])


def write_tables(study: Study, folder: Path) -> list[Path]:
    """Write `tradeoff.parquet`, `errors.parquet` and `study.json`, each whole or not at all; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    wide = pa.Table.from_pylist([_wide(row) for row in study.rows], wide_schema())
    long = pa.Table.from_pylist([line for row in study.rows for line in _long(row)], LONG_SCHEMA)
    text = json.dumps({"verso_study": STUDY_VERSION, **_plain(study)}, indent=1, default=_plain) + "\n"
    return [
        _replace(folder / WIDE_FILE, lambda file: pq.write_table(wide, file)),
        _replace(folder / LONG_FILE, lambda file: pq.write_table(long, file)),
        _replace(folder / STUDY_FILE, lambda file: file.write_text(text, encoding="utf-8")),
    ]


def _names(row: Row) -> dict[str, str]:
    """A setting's name, knobs and values; those of a combination are joined by commas."""
    knobs, values = (", ".join(part[place] for part in row.setting.parts) for place in (0, 1))
    return {"setting": row.setting.name, "knob": knobs, "value": values}


def _wide(row: Row) -> dict[str, Any]:
    line: dict[str, Any] = {**_names(row), "changes": json.dumps(dict(row.setting.changes)), "notes": list(row.notes)}
    for name, figure in row.errors.items():
        line |= {name: figure.value, f"{name}_low": figure.low, f"{name}_high": figure.high}
    return line | {name: getattr(row, name) for name in _COST}


def _long(row: Row) -> list[dict[str, Any]]:
    setting, lines = _names(row) | {"ms": row.ms, "ratio": row.ratio}, []
    for name, figure in row.errors.items():
        error = {"error": name, "unit": ERRORS[name].unit, "group": ERRORS[name].group, "amount": figure.value}
        lines.append({**asdict(figure), **error, **setting})
    return lines


def _plain(value: Any) -> Any:
    """One level of a value that JSON does not know: a dataclass, a mapping that is no dict, or a number of numpy."""
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return dict(value) if isinstance(value, Mapping) else value.item()


def _replace(file: Path, write: Callable[[Path], Any]) -> Path:
    """Write under another name in the same folder, then rename, so that no reader sees half a file."""
    partial = file.with_name(f".{file.name}.{os.getpid()}")
    write(partial)
    os.replace(partial, file)
    return file

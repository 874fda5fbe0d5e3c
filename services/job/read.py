"""Reads a job file into a `Job`. An error names the file, the key, its value and what is allowed."""

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from schemas.errors import JobError
from schemas.job.job import Job
from schemas.job.keys import set_key
from services.job.reference import allowed_keys


class _StrictLoader(yaml.SafeLoader):
    """A safe YAML loader that refuses a key written twice, where YAML's own keeps the last."""


def _mapping(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[Any] = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node)
        if not isinstance(key, str):
            raise JobError(f"line {key_node.start_mark.line + 1}: the key {key!r} is not a word")
        if key in seen:
            raise JobError(f"line {key_node.start_mark.line + 1}: the key '{key}' is written twice")
        seen.add(key)
    return loader.construct_mapping(node, deep=True)


_StrictLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def load_job(path: Path, changes: Sequence[str] = ()) -> Job:
    """Read a job file and apply `path.to.key=value` changes. Raises JobError."""
    return validate_job(read_tree(path, changes), str(path))


def read_tree(path: Path, changes: Sequence[str] = ()) -> dict[str, Any]:
    """The keys of a job file with `path.to.key=value` changes, without defaults. Raises JobError."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise JobError(f"{path}: no such file; the examples are in deploy/jobs/") from error
    except (OSError, UnicodeDecodeError) as error:
        raise JobError(f"{path}: cannot be read as text: {error}") from error
    try:
        tree = yaml.load(text, Loader=_StrictLoader)
    except yaml.YAMLError as error:
        raise JobError(f"{path}: not YAML: {' '.join(str(error).split())}") from error
    except JobError as error:
        raise JobError(f"{path}: {error}") from error
    if not isinstance(tree, dict):
        found = type(tree).__name__ if tree is not None else "nothing"
        raise JobError(f"{path}: holds {found}, and must hold keys and values")
    for change in changes:
        change_key(tree, change)
    return tree


def change_key(tree: dict[str, Any], change: str) -> None:
    """Apply one `path.to.key=value` in place; the value is read as YAML. Raises JobError."""
    path, equals, text = change.partition("=")
    if not equals or not path:
        raise JobError(f"--set {change}: write it as path.to.key=value, for example --set physics.step_hz=480")
    try:
        set_key(tree, path, yaml.load(text, Loader=_StrictLoader))
    except yaml.YAMLError as error:
        raise JobError(f"--set {change}: the value is not YAML: {' '.join(str(error).split())}") from error
    except ValueError as error:
        raise JobError(f"--set {change}: {error}") from error


def validate_job(tree: dict[str, Any], name: str) -> Job:
    """A `Job` from parsed keys. Raises JobError with one line for each fault."""
    version = tree.get("verso", 1)
    if isinstance(version, int) and version > 1:
        newer = f"{version} is newer than this program, which reads version 1: install a newer Verso"
        raise JobError(f"{name}: verso: {newer}")
    try:
        return Job.model_validate(tree)
    except ValidationError as error:
        faults = error.errors()
        # An invalid item of a list makes the list itself count as too short: that line would confuse.
        told = [fault for fault in faults if fault["type"] != "too_short" or len(faults) == 1]
        raise JobError("\n".join(f"{name}: {describe_fault(fault)}" for fault in told)) from error


def describe_fault(fault: Any) -> str:
    """One line: the key's path, its value, and what is allowed."""
    words = [str(part) for part in fault["loc"] if part not in ("procedural", "shapenet", "urdf", "[key]")]
    key = ".".join(words) or "the job"
    if fault["type"] == "extra_forbidden":
        allowed = allowed_keys(words)
        return f"{key}: there is no such key; {did_you_mean(words[-1], allowed)}Allowed here: {', '.join(allowed) or 'nothing'}"
    if fault["type"] == "missing":
        return f"{key}: is missing, and has no default"
    message = fault["msg"].removeprefix("Value error, ")
    value = repr(fault["input"])
    return f"{key}: {value if len(value) <= 80 else value[:77] + '...'}: {message[0].lower()}{message[1:]}"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A question with the nearest of the known words and a space behind it; empty where none is near."""
    near = difflib.get_close_matches(word, known, n=1)
    return f"did you mean '{near[0]}'? " if near else ""

"""Dotted keys of a job tree, such as `physics.rest.speed_mm_s` or `assets.objects.0.weight`."""

import copy
from collections.abc import Mapping
from contextlib import suppress
from typing import Any


def with_defaults(tree: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a tree with values by dotted key where it has none; a path through a value without keys is left out."""
    filled = copy.deepcopy(dict(tree))
    for path, value in defaults.items():
        with suppress(ValueError):
            set_key(filled, path, value, keep=True)
    return filled


def set_key(tree: dict[str, Any], path: str, value: object, keep: bool = False) -> None:
    """Set one key in place; branches that are missing are made, and a position in a list counts from 0.

    With `keep`, a value that is there already stays. Raises ValueError where the path leads through a value that has no keys.
    """
    *parents, last = path.split(".")
    branch: Any = tree
    for key in parents:
        branch = _open_branch(branch, key)
        if branch is None:
            raise ValueError(f"there is nothing at '{key}' to set a key of")
    if isinstance(branch, list):
        branch[_position(branch, last)] = value
    elif not isinstance(branch, dict):
        raise ValueError(f"'{'.'.join(parents)}' is {branch!r} and has no keys")
    elif not (keep and last in branch):
        branch[last] = value


def _open_branch(branch: Any, key: str) -> Any:
    if isinstance(branch, dict):
        return branch.setdefault(key, {})
    if isinstance(branch, list):
        return branch[_position(branch, key)]
    raise ValueError(f"{branch!r} has no key '{key}'")


def _position(items: list[Any], key: str) -> int:
    if not key.isdigit() or int(key) >= len(items):
        raise ValueError(f"'{key}' must be a position from 0 to {len(items) - 1}")
    return int(key)

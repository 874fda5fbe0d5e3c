"""The settings of `verso capture` commands: a job of one capture, with the keys that --set changes."""

from collections.abc import Mapping, Sequence
from typing import Any

from schemas.job.captures import Captures
from schemas.job.job import Job
from schemas.job.keys import set_key
from services.job.job_file import change_key, validate_job


def capture_job(changes: Sequence[str] = (), keys: Mapping[str, Any] | None = None) -> Job:
    """A job named `capture`: the dotted `keys` of a command's own options, then `path.to.key=value` of --set.

    A key whose value is None is left at its default. Raises JobError, which is wrong input.
    """
    tree: dict[str, Any] = {"name": "capture", "scenes": 1, "captures": {}}
    for path, value in (keys or {}).items():
        if value is not None:
            set_key(tree, path, value)
    for change in changes:
        change_key(tree, change)
    return validate_job(tree, "verso capture")


def capture_settings(changes: Sequence[str] = (), keys: Mapping[str, Any] | None = None) -> Captures:
    """The branch `captures` of that job. Raises JobError."""
    captures = capture_job(changes, keys).captures
    assert captures is not None
    return captures

"""Proof, before any work, that a file system can do what commits stand on."""

import contextlib
import os
import uuid
from pathlib import Path

from schemas.dataset.layout import COMMITS
from schemas.errors import OutputError
from workers.store.durable import sync_file, sync_folder
from workers.store.mounts import file_system_of
from workers.store.store import PROBE_PREFIX, TEMPORARY

_TRIES = 3
"""A coordinator that already works here may sweep the probe's files away: they are then written again."""


def probe_folder(root: Path) -> None:
    """Returns where linking refuses a second name, renaming replaces and syncing works under `root`.

    Raises OutputError naming what failed, the type of the file system and a remedy.
    """
    for last in range(_TRIES):
        with contextlib.suppress(*([FileNotFoundError] if last < _TRIES - 1 else [])):
            return _probe_once(root)


def _probe_once(root: Path) -> None:
    token = uuid.uuid4().hex
    source = root / TEMPORARY / f"{PROBE_PREFIX}{token}"
    target = root / COMMITS / f"{PROBE_PREFIX}{token}"
    step = "writing a file"
    try:
        source.write_bytes(b"probe")
        step = "fsync"
        sync_file(source)
        step = "a hard link"
        os.link(source, target)
        sync_folder(target.parent)
        step = "refusing a second hard link to one name"
        _must_refuse(source, target)
        step = "rename"
        os.unlink(target)
        os.replace(source, target)
        if source.exists() or target.read_bytes() != b"probe":
            raise OSError("the renamed file reads back differently")
    except FileNotFoundError:
        raise
    except OSError as error:
        raise OutputError(
            f"{root} is on a file system of type {file_system_of(root)} that fails at {step} "
            f"({error.strerror or error}): commits there would not be safe. "
            "Choose an --out on a local disk (ext4, xfs, btrfs) or NFS"
        ) from error
    finally:
        for path in (source, target):
            with contextlib.suppress(OSError):
                os.unlink(path)


def _must_refuse(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except FileExistsError:
        return
    raise OSError("a second link was accepted")

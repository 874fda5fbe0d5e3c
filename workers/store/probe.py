"""A check, before any work, that a file system can do what commits rely on."""

import contextlib
import os
import uuid
from pathlib import Path

from schemas.dataset.layout import COMMITS, PROBE_PREFIX, TEMPORARY
from schemas.errors import OutputError
from workers.store.durable import sync_path
from workers.store.mounts import file_system_of
from workers.store.store import retry_if_swept


def probe_folder(root: Path) -> None:
    """Returns where linking refuses a second name, renaming replaces and syncing works under `root`.

    Raises OutputError naming the step that failed, the type of the file system and a remedy.
    """
    retry_if_swept(lambda: _probe_once(root))


def _probe_once(root: Path) -> None:
    name = f"{PROBE_PREFIX}{uuid.uuid4().hex}"
    source, target = root / TEMPORARY / name, root / COMMITS / name
    step = "writing a file"
    try:
        source.write_bytes(b"probe")
        step = "fsync"
        sync_path(source)
        step = "a hard link"
        os.link(source, target)
        sync_path(target.parent)
        step = "refusing a second hard link to one name"
        with contextlib.suppress(FileExistsError):
            os.link(source, target)
            raise OSError("a second link was accepted")
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

"""The folder that an export writes: claimed, filled whole file by whole file, and gone on with after a kill.

While it is being made, `_export/` in it holds what was asked, how far it came, and files that are not finished.
`export.json`, written last, says what is there and what was left out. A file has its final name only when it is whole.
"""

import contextlib
import csv
import io
import json
import os
import shutil
import sqlite3
import urllib.parse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from schemas.errors import CorruptError, OutputError
from workers.pool import alone_in

WORK = "_export"
MANIFEST = "export.json"
_PLAN, _PROGRESS, _LOCK, _TEMPORARY, _PARTS = "plan.json", "progress.json", "lock", "tmp", "parts"

Tree = dict[str, Any]


class ExportFolder:
    """A claimed folder. `put` writes a whole file; `append` grows one that gets its name when all is done."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.work = root / WORK
        self.plan: Tree = {}
        """What was asked when the export began."""
        self._waiting: dict[str, list[bytes]] = {}
        self._sizes: dict[str, int] = {}
        """Bytes of the growing files, those that wait included."""

    @contextlib.contextmanager
    def claimed(self, plan: Tree) -> Iterator["Tree | None"]:
        """Holds the folder for an export; yields how far it came, None where it begins.

        Raises OutputError where the folder holds somebody else's files, another export, or cannot be written, InUseError
        where another process works in it.
        """
        names: list[str] = []
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            names = sorted(os.listdir(self.root))
        if names and WORK not in names:
            message = f"{self.root} holds {', '.join(names[:3])}{' and more' if len(names) > 3 else ''}"
            raise OutputError(f"{message}: an export goes into a new or an empty folder, choose another DIR")
        with alone_in(self.root, f"{WORK}/{_LOCK}", "verso export"):
            shutil.rmtree(self.work / _TEMPORARY, ignore_errors=True)
            (self.work / _TEMPORARY).mkdir()
            known = _read_tree(self.work / _PLAN)
            if known is None:
                self.put(f"{WORK}/{_PLAN}", json.dumps(plan).encode())
            else:
                # A run that went on may have finished the dataset: the export is of what was there at first.
                self.refuse_other(known, {**plan, "dataset_digest": known.get("dataset_digest")})
            self.plan = known or plan
            progress = _read_tree(self.work / _PROGRESS)
            self._cut_parts({} if progress is None else progress["parts"])
            yield progress

    def refuse_other(self, known: Tree, plan: Tree) -> None:
        """Raises OutputError where the export in the folder is not the one that is asked for."""
        if differing := sorted(key for key in plan if known.get(key) != plan[key]):
            message = "; ".join(f"{key}: {known.get(key)} there, {plan[key]} here" for key in differing)
            raise OutputError(f"{self.root} holds another export, and these differ: {message}; choose another DIR")

    def finished(self) -> Tree | None:
        """What a finished export says of itself, None where there is none."""
        return None if self.work.exists() else _read_tree(self.root / MANIFEST)

    def put(self, path: str, data: bytes) -> None:
        """Writes a whole file, replacing what a killed export left there."""
        temporary = self.temporary()
        temporary.write_bytes(data)
        self.install(temporary, path)

    def temporary(self, name: str = "file") -> Path:
        """A name in the same file system for what is not finished; what a killed export left there is gone."""
        return self.work / _TEMPORARY / name

    def install(self, local: Path, path: str) -> None:
        """Gives a finished file, or a finished folder that is not there yet, its final name in one step."""
        target = self.root / path
        try:
            os.replace(local, target)
        except FileNotFoundError:
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(local, target)

    def append(self, path: str, data: bytes) -> None:
        """Adds to a file that gets its name when the export is finished."""
        self._waiting.setdefault(path, []).append(data)
        self._sizes[path] = self._sizes.get(path, 0) + len(data)

    def append_row(self, path: str, row: Iterable[object]) -> None:
        """Adds a line to a CSV file that grows."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(row)
        self.append(path, text.getvalue().encode())

    def checkpoint(self, progress: Tree) -> None:
        """From here a killed export goes on: what was put and appended before counts, what comes after is made again."""
        for path, pieces in self._waiting.items():
            part = self._part(path)
            part.parent.mkdir(exist_ok=True)
            with open(part, "ab") as file:
                file.write(b"".join(pieces))
        self._waiting = {}
        self.put(f"{WORK}/{_PROGRESS}", json.dumps({**progress, "parts": self._sizes}).encode())

    def finish(self, manifest: Tree) -> None:
        """Gives every growing file its name, writes the manifest, and clears away the rest. After a checkpoint alone."""
        for path in sorted(self._sizes):
            with contextlib.suppress(FileNotFoundError):  # a killed export was here already
                self.install(self._part(path), path)
        self.put(MANIFEST, (json.dumps(manifest, indent=1, ensure_ascii=False) + "\n").encode())
        shutil.rmtree(self.work)

    def _cut_parts(self, sizes: dict[str, int]) -> None:
        """Takes away what a killed export appended after its last checkpoint."""
        self._sizes = dict(sizes)
        kept = {self._part(path): size for path, size in sizes.items()}
        for part in (self.work / _PARTS).glob("*"):
            if part not in kept:
                part.unlink()
        for part, size in kept.items():
            with contextlib.suppress(FileNotFoundError):  # installed: it was about to finish
                if part.stat().st_size < size:
                    message = f"{part} is shorter than the export left it"
                    raise CorruptError(f"{message}: remove {self.root}, and start again")
                os.truncate(part, size)

    def _part(self, path: str) -> Path:
        return self.work / _PARTS / urllib.parse.quote(path, safe="")


def _read_tree(path: Path) -> Tree | None:
    """The object in a JSON file, None where there is no file. Raises CorruptError where it holds something else."""
    try:
        tree = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        return None
    except ValueError:
        tree = None
    if not isinstance(tree, dict):
        raise CorruptError(f"{path} is damaged: remove the folder {path.parent.parent}, and export again")
    return tree


class Register:
    """Entries numbered from 1 in the order in which they came, each with a key and a text; on the disk, in constant memory."""

    def __init__(self, folder: ExportFolder, after: int) -> None:
        """`after`: what `state` was; entries of a killed export that came later are gone."""
        self._db = sqlite3.connect(folder.work / "register.sqlite")
        self._db.execute("PRAGMA synchronous = OFF")  # a power loss is not what this is for
        self._db.execute("CREATE TABLE IF NOT EXISTS entries (id INTEGER PRIMARY KEY, key TEXT, text TEXT)")
        self._db.execute("CREATE INDEX IF NOT EXISTS by_key ON entries (key)")
        self._db.execute("DELETE FROM entries WHERE id > ?", (after,))
        self._last = after

    def add(self, key: str, text: str = "") -> int:
        """The number of a new entry."""
        self._last += 1
        self._db.execute("INSERT INTO entries VALUES (?, ?, ?)", (self._last, key, text))
        return self._last

    def of(self, key: str) -> list[tuple[int, str]]:
        """(number, text) of the entries of a key, in order."""
        return self._db.execute("SELECT id, text FROM entries WHERE key = ? ORDER BY id", (key,)).fetchall()

    def counts(self) -> Iterator[tuple[str, int]]:
        """(key, how many entries it has), sorted."""
        yield from self._db.execute("SELECT key, COUNT(*) FROM entries GROUP BY key ORDER BY key")

    def state(self) -> int:
        """The last number; the entries are safe on the disk."""
        self._db.commit()
        return self._last

    def close(self) -> None:
        """Closes the file."""
        self._db.close()

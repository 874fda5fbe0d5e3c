"""The journal of a study: a file of answers, with which the same command goes on where it stopped."""

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from schemas.errors import OutputError

JOURNAL_FILE = "journal.jsonl"


class Journal(dict[str, Any], AbstractContextManager):
    """Answers by the unit's name, one JSON line each; the first line identifies the study.

    A line that the end of a process cut off is dropped, and its unit measured again.
    """

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        """Raises OutputError where the folder cannot be written, or holds another study."""
        self._path = folder / JOURNAL_FILE
        super().__init__()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("a+b")
        except OSError as error:
            raise OutputError(f"{folder} cannot be written: {error.strerror or error}; choose another --out") from error
        try:
            self._read(header)
        except BaseException:
            self._file.close()
            raise

    def _read(self, header: Mapping[str, Any]) -> None:
        self._file.seek(0)
        written = self._file.read()
        whole = written[: written.rfind(b"\n") + 1]
        self._file.truncate(len(whole))
        if not whole:
            self._write(header)
            return
        first, *entries = map(json.loads, whole.splitlines())
        wanted = json.loads(json.dumps(header))
        if other := sorted(key for key in {*first, *wanted} if first.get(key) != wanted.get(key)):
            raise OutputError(
                f"{self._path.parent} holds the measurements of another study (other {', '.join(other)}): choose another "
                f"--out, or delete {self._path.name} there"
            )
        self.update((entry["unit"], entry["answer"]) for entry in entries)

    def add(self, unit: str, answer: Any) -> None:
        """Keep an answer, on disk too."""
        self[unit] = answer
        self._write({"unit": unit, "answer": answer})

    def _write(self, entry: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(entry, sort_keys=True).encode() + b"\n")
        self._file.flush()

    def __exit__(self, *_: object) -> None:
        self._file.close()

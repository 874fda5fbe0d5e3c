"""What is measured, unit by unit, in a file that outlives the process: the same command goes on where it stopped."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from schemas.errors import OutputError

JOURNAL_FILE = "journal.jsonl"


class Journal:
    """Answers by the name of what was asked, one JSON line each; the first line says of which study.

    A line that was cut off by the end of a process is dropped, and its unit measured again.
    """

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        """Raises OutputError where the folder cannot be written, or holds another study."""
        self._path = folder / JOURNAL_FILE
        self._answers: dict[str, Any] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lines = self._path.read_text(encoding="utf-8").split("\n") if self._path.exists() else []
            kept = self._read([line for line in lines[:-1] if line], header)
            self._path.write_text("".join(f"{line}\n" for line in kept or [_line(header)]), encoding="utf-8")
            self._file = self._path.open("a", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{folder} cannot be written: {error.strerror or error}; choose another --out") from error

    def _read(self, lines: list[str], header: Mapping[str, Any]) -> list[str]:
        if not lines:
            return []
        found = json.loads(lines[0])
        if other := sorted(key for key in {*found, *header} if found.get(key) != header.get(key)):
            raise OutputError(
                f"{self._path.parent} holds the measurements of another study (other {', '.join(other)}): choose another "
                f"--out, or delete {self._path.name} there"
            )
        for line in lines[1:]:
            entry = json.loads(line)
            self._answers[entry["unit"]] = entry["answer"]
        return lines

    def __contains__(self, unit: str) -> bool:
        return unit in self._answers

    def __getitem__(self, unit: str) -> Any:
        return self._answers[unit]

    def add(self, unit: str, answer: Any) -> None:
        """Keep what was measured."""
        self._answers[unit] = answer
        self._file.write(_line({"unit": unit, "answer": answer}) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Give the file back."""
        self._file.close()


def _line(entry: Mapping[str, Any]) -> str:
    return json.dumps(entry, sort_keys=True)

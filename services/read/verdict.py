"""The result of `verso verify`, and errors of damaged files in one line."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import pyarrow as pa

from schemas.dataset.layout import SUCCESS_FILE, commit_path
from schemas.errors import CorruptError, command_line
from workers.store.store import Store

MOST_FAULTS = 1_000
"""Faults of one part that are kept as lines; more are only counted, so that a lost disk does not fill the memory."""


Part = Literal["commit", "file", "job", "merge", "card", "stray"]
"""The part of a dataset that a fault is in: its commits and labels, files that commits name, job.yaml and the fingerprint,
what the merge writes, DATASET.md, and what belongs nowhere."""


@dataclass
class Verdict:
    """Counts of what was read, and the faults, a line each."""

    out: str = "OUT"
    """The dataset's place, as remedies name it."""
    files: int = 0
    bytes: int = 0
    scenes: int = 0
    pairs: int = 0
    """Pairs whose labels were derived again."""
    not_derived: str = ""
    """Why none were, where what makes data is not installed."""
    faults: list[str] = field(default_factory=list)
    untold: int = 0
    """Faults beyond `MOST_FAULTS`."""
    parts: dict[Part, int] = field(default_factory=dict)
    """Faults by the part that they are in."""

    def tell(self, what: str, remedy: str, part: Part = "commit") -> None:
        """Adds a fault as one line: what is wrong with which file, and what to do."""
        self.parts[part] = self.parts.get(part, 0) + 1
        if self.parts[part] <= MOST_FAULTS:
            self.faults.append(f"{printable(what)}: {remedy}")
        else:
            self.untold += 1

    def make_again(self, start: int) -> str:
        """The remedy for a lost file of the range at `start`: its scenes, and so its files, come out the same again."""
        commits = commit_path(start).replace(".json", "*.json")
        return f"{COPY}, or remove it, {commits} and {SUCCESS_FILE}, and {self.run_again}"

    @property
    def merge_again(self) -> str:
        """The remedy for what the end of a run writes."""
        return f"remove it and {SUCCESS_FILE}, and {self.run_again}"

    @property
    def run_again(self) -> str:
        """The remedy for what is not there yet, or is no longer."""
        return f"run the job again with --out {self.out}"


COPY = "restore it from a copy"
MOVE = "move it away"


def printable(text: str) -> str:
    """The text as one line that any terminal can print: other characters are escaped."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def describe_os_error(error: OSError) -> str:
    """Why a file cannot be read, in few words."""
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return "is missing"
    if isinstance(error, IsADirectoryError):
        return "is a folder, where a file should be"
    return f"cannot be read ({error.strerror or error})"


def read_or_tell(store: Store, key: str, verdict: Verdict, remedy: str, part: Part) -> bytes | None:
    """The bytes of a file; None where it cannot be read, which is told."""
    try:
        return store.read(key)
    except OSError as error:
        verdict.tell(f"{key}: {describe_os_error(error)}", remedy, part)
        return None


@contextlib.contextmanager
def explain_damage(store: Store) -> Iterator[None]:
    """Raises CorruptError with one line where the block meets a file that cannot be read as what it should be."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        where = str(error.filename or store.name)
        fault = f"{where}: {describe_os_error(error)}"
    except (ValueError, pa.ArrowException) as error:
        fault = f"{store.name} holds a damaged file: {(str(error).splitlines() or [type(error).__name__])[0]}"
    else:
        return
    raise CorruptError(f"{printable(fault)}; `{command_line('verify', store.name)}` lists every damaged file")

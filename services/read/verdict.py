"""The result of `verso verify`: counts of what was read, and faults, each a line with the file and what to do."""

from dataclasses import dataclass, field
from typing import Literal

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

    @property
    def repair(self) -> str:
        """The remedy for what can be made again."""
        return f"`verso replay {self.out} --repair` puts it back, or restore it from a copy"

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

"""A folder of a capture as a job found it: where it lies, and the digest of what is in it."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class CaptureListing:
    """folder: absolute; sha256: hex, of the names and the bytes of every input file."""

    folder: Path
    sha256: str

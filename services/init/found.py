"""What `verso init` found in a folder: files that can be used, and those that are left out, with the reason."""

from dataclasses import dataclass

from workers.assets.external.placement import Measured

PART, COPY = "part", "copy"
"""The reasons why a mesh is not an object by itself: a file names it; it is a collision shape, a coarser level, a double."""


@dataclass(frozen=True)
class Item:
    """A file that can be used, what was measured of it, one digest over all files that it reads, and its category."""

    path: str
    measured: Measured
    digest: str
    category: str = ""

    @property
    def suffix(self) -> str:
        """The end of its name, in small letters."""
        return self.path[self.path.rfind(".") :].lower()

    @property
    def diagonal(self) -> float:
        """Of its bounding box, in units of the file."""
        return float(sum(extent * extent for extent in self.measured.extents) ** 0.5)


@dataclass(frozen=True)
class LeftOut:
    """A file that is not used: why in a word, and in a sentence without its subject, with the remedy."""

    path: str
    reason: str
    why: str


@dataclass(frozen=True)
class Reading:
    """Everything that a folder has. `refused`: those left out because they cannot be read, which a job leaves out too."""

    items: tuple[Item, ...]
    left_out: tuple[LeftOut, ...]
    refused: frozenset[str] = frozenset()

"""What was found in a folder of meshes: what a job can be made of, and what was left out and why."""

from dataclasses import dataclass

from schemas.job.assets import UpAxis
from workers.assets.external.measured import Measured


@dataclass(frozen=True)
class Candidate:
    """A file that may be an object: its path below the folder, and the category that it would have."""

    path: str
    category: str


@dataclass(frozen=True)
class Item:
    """A file that can be used, what was measured of it, and one digest over all files that it reads."""

    path: str
    category: str
    measured: Measured
    digest: str

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
    """A file that is not used: why in a word, and in a sentence with the remedy."""

    path: str
    reason: str
    why: str


@dataclass(frozen=True)
class Reading:
    """Everything that a folder has. `refused`: those left out because they cannot be read, which a job leaves out too."""

    items: tuple[Item, ...]
    left_out: tuple[LeftOut, ...]
    refused: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Scale:
    """How the files of some formats are scaled: `factor` to metres, or to `diagonal_m` where sizes are normalised; why."""

    suffixes: tuple[str, ...]
    factor: float
    why: str
    diagonal_m: float | None = None


@dataclass(frozen=True)
class UpRule:
    """The axis that is up in the files that a pattern finds, how far that is to be believed, and why."""

    pattern: str
    axis: UpAxis
    why: str


@dataclass(frozen=True)
class Guess:
    """What a job says of a folder: scales, the axes that are up (the first rule that matches), and patterns of categories."""

    scales: tuple[Scale, ...]
    ups: tuple[UpRule, ...]
    category_map: dict[str, str]
    """Category by pattern; the first match wins."""

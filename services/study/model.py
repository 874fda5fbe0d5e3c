"""The models of a study of accuracy against time: knobs, settings, its plan, and rows of its table."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from schemas.job.job import Job

Group = Literal["physics", "labels", "mirror", "colour", "capture"]
"""The part of a scene that a knob or an error belongs to: how objects come to rest; depth and masks; the mirror pose and the
projection into its view; RGB; or a capture as a whole."""

Changes = Mapping[str, Any]
"""Values by dotted key of the job, such as {"physics.step_hz": 240}."""


@dataclass(frozen=True)
class Value:
    """One value of a knob: its label in tables and plots, the keys of the job that it sets, and a package that it needs."""

    label: str
    changes: Changes
    package: str | None = None


@dataclass(frozen=True)
class Knob:
    """One property that is turned; its values go from coarse to fine where they have an order."""

    name: str
    group: Group
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Setting:
    """The job with some keys changed. `parts` names (knob, label of its value): none for the job itself, two for a pair."""

    parts: tuple[tuple[str, str], ...] = ()
    changes: Changes = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Such as "step=240" or "step=240, tier=flat"; "the job" where nothing is changed."""
        return ", ".join(f"{knob}={label}" for knob, label in self.parts) or "the job"

    @property
    def knob(self) -> str:
        """The first of its knobs; empty for the job itself."""
        return self.parts[0][0] if self.parts else ""

    @property
    def kind(self) -> Literal["own", "preset", "single", "several"]:
        """The job itself, a preset, one knob turned, or several."""
        if not self.parts:
            return "own"
        return "preset" if self.parts[0][0] == "preset" else "single" if len(self.parts) == 1 else "several"


@dataclass(frozen=True)
class Figure:
    """An error of a setting: its value, its 95 % confidence interval by bootstrap over scenes, and their number."""

    value: float
    low: float
    high: float
    median: float
    scenes: int


@dataclass(frozen=True)
class Row:
    """A setting as measured.

    `ratio` of its time to the job's own in the same rounds: median, least and most; `ms`: that ratio times the job's own
    median milliseconds of processor a scene; `kilobytes` a scene on disk; `errors`: the measured figures by name of
    `ERRORS`; `notes`: what is missing, and why.
    """

    setting: Setting
    ms: float
    ratio: float
    ratio_least: float
    ratio_most: float
    kilobytes: float
    errors: Mapping[str, Figure]
    failed_share: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Study:
    """The content of a report: the machine, the command, the table, and the slopes of smooth cases.

    `scenes` were made with each setting and `physics_scenes` dropped; `job_scenes` is the size of the whole job, 0 where its
    cost is not told; `notes` hold for the whole study, such as what was not measured, and why.
    """

    job: str
    command: str
    machine: Mapping[str, Any]
    scenes: int
    physics_scenes: int
    rows: tuple[Row, ...]
    slopes: Mapping[str, float] = field(default_factory=dict)
    preset: str = "balanced"
    job_scenes: int = 0
    notes: tuple[str, ...] = ()

    @property
    def sample(self) -> str:
        """What was measured with each setting, in words: a study of captures drops nothing."""
        if not self.physics_scenes:
            return f"{self.scenes} captures processed"
        return f"{self.scenes} scenes made and {self.physics_scenes} dropped"


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes.

    `scenes` have their images measured. `settled` only come to rest; the first `released` of them are released again, and
    the first `posed` have their poses compared with the truth. `timed` are timed in each of `laps` rounds; `coloured` are
    drawn with very many paths.
    """

    scenes: int = 48
    settled: int = 500
    released: int = 16
    posed: int = 48
    timed: int = 12
    laps: int = 3
    coloured: int = 4


@dataclass(frozen=True)
class Plan:
    """The job that is timed, its knobs and settings, the presets, the targets, and the sizes."""

    job: Job
    job_folder: Path
    knobs: tuple[Knob, ...]
    settings: tuple[Setting, ...]
    presets: tuple[Setting, ...]
    targets: Mapping[str, float] | None
    sizes: Sizes = field(default_factory=Sizes)

"""What a study of accuracy against time is made of: knobs, settings, errors, and rows of its table."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Group = Literal["physics", "labels", "mirror", "colour"]
"""Which part of a scene a knob or an error belongs to: how objects come to rest; depth and masks; the mirror pose and what
is carried into its view; RGB."""

Changes = Mapping[str, Any]
"""Values by dotted key of the job, such as {"physics.step_hz": 240}."""


@dataclass(frozen=True)
class Value:
    """One value of a knob: how it is called in tables and plots, and the keys of the job that it sets."""

    label: str
    changes: Changes


@dataclass(frozen=True)
class Knob:
    """What is turned, in the order from coarse to fine where there is one.

    `errors`: names of `ERRORS` that it may move, the first of which its plot shows; `package`: what must be installed for
    values named in `needs`.
    """

    name: str
    title: str
    group: Group
    errors: tuple[str, ...]
    values: tuple[Value, ...]
    package: str | None = None
    needs: frozenset[str] = frozenset()


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
    def kind(self) -> Literal["own", "preset", "single", "several"]:
        """The job itself, a preset, one knob turned, or several."""
        if not self.parts:
            return "own"
        return "preset" if self.parts[0][0] == "preset" else "single" if len(self.parts) == 1 else "several"


@dataclass(frozen=True)
class ErrorKind:
    """One error: its unit, what it says, in words for a reader, and which part of a scene it is of. Less is better.

    A scene has one figure of it, and a setting the 95th percentile of its scenes', or where it is `pooled` one figure over
    all its scenes. `truth` is what it is held against.
    """

    name: str
    unit: str
    title: str
    truth: str
    group: Group
    pooled: bool = False


@dataclass(frozen=True)
class Figure:
    """An error of a setting: its value, the 95 % confidence interval of it by bootstrap over scenes, and of how many."""

    value: float
    low: float
    high: float
    median: float
    scenes: int


@dataclass(frozen=True)
class Row:
    """A setting as measured.

    `ratio` of its time to the job's own in the same rounds: median, least and most; `ms`: that ratio times the job's own
    median milliseconds of processor a scene; `kilobytes` a scene on disk; `errors`: figures by name of `ERRORS`, those that
    were measured; `notes`: what is missing, and why.
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
    """Everything that a report says: the machine, the command, the table, and the slopes of smooth cases.

    `scenes` were made with each setting, `physics_scenes` dropped; `job_scenes` are those of the whole job, whose cost is
    told where there are any; `notes`: what holds for the study as a whole, such as what was not measured, and why.
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

"""The models of a study of accuracy against time, the errors that it measures, and how amounts are written. Pure.

An error names the truth that it is held against, which is never the setting under test.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from schemas.errors import number
from schemas.job.job import Job

Group = Literal["physics", "labels", "mirror", "colour", "capture"]
"""The part of a scene that an error belongs to: how objects come to rest; depth and masks; the mirror pose and the
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


OWN = Setting()
"""The job as it is."""


Verdict = Literal["meets", "misses", "open"]


@dataclass(frozen=True)
class Figure:
    """An error of a setting: its value, its 95 % interval by bootstrap over these scenes, and their number.

    The bootstrap knows no scene worse than the worst of its own, so that its upper end tells settings of the same scenes
    apart, and says little of other scenes: `least` and `most` are the bounds for those (services/study/table.py), None where
    there are no better ones. `less`: whether it is surely less than the job's own in most scenes, None where nothing tells.
    """

    value: float
    low: float
    high: float
    median: float
    scenes: int
    most: float | None = None
    less: bool | None = None
    least: float | None = None

    @property
    def bound(self) -> float:
        """What the error of as many scenes as one likes is at most, with 95 % confidence."""
        return max(self.value, self.high if self.most is None else self.most)

    def verdict(self, target: float) -> Verdict:
        """Whether the error of as many scenes as one likes is surely (95 %) at most a target, or surely above it."""
        least = self.low if self.least is None else self.least
        return "meets" if self.bound <= target else "misses" if least > target else "open"

    def scaled(self, times: float, most: float) -> "Figure":
        """Times a factor, and at most `most`."""
        ends = {name: getattr(self, name) for name in ("value", "low", "high", "median", "most", "least")}
        return replace(self, **{name: min(most, end * times) for name, end in ends.items() if end is not None})


@dataclass(frozen=True)
class Row:
    """A setting as measured.

    `ratio` of its time to the job's own in the same scenes, and its 95 % interval, least to most; `ms`: that ratio times the
    job's own milliseconds of processor a scene; `kilobytes` a scene on disk; `errors`: the measured figures by name of
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
class Proof:
    """A recommended setting on fresh scenes, all its parts at once: its figure of each target, and whether all hold."""

    setting: str
    scenes: int
    targets: Mapping[str, float]
    measured: Mapping[str, Figure]
    promised: Mapping[str, Figure]

    @property
    def missed(self) -> tuple[str, ...]:
        """The errors whose measured figure is above its target, or is not there."""
        known = self.measured
        return tuple(name for name, most in self.targets.items() if name not in known or not known[name].value <= most)

    @property
    def holds(self) -> bool:
        """Whether every measured figure is at or below its target."""
        return not self.missed


@dataclass(frozen=True)
class Study:
    """The content of a report: the machine, the command, and the table.

    `scenes` is the most that a setting was measured in; `job_scenes` is the size of the whole job, 0 where its cost is not
    told; `seconds` were spent of a budget of `budget_s`; `answer` is the answer in words and `chosen` the name of the
    setting in it, empty where nothing is recommended; `doubts` are what is not decided, and how long that would take;
    `notes` hold for the whole study, such as what was not measured, and why.
    """

    job: str
    command: str
    machine: Mapping[str, Any]
    scenes: int
    rows: tuple[Row, ...]
    preset: str = "balanced"
    job_scenes: int = 0
    notes: tuple[str, ...] = ()
    budget_s: float = 0.0
    seconds: float = 0.0
    answer: str = ""
    chosen: str = ""
    doubts: tuple[str, ...] = ()
    proofs: tuple[Proof, ...] = ()

    @property
    def sample(self) -> str:
        """What was measured, in words."""
        return f"up to {self.scenes} scenes with each of {len(self.rows)} settings"


@dataclass(frozen=True)
class Plan:
    """The job that is measured, its settings, the presets, the targets, the seconds to spend, and processes."""

    job: Job
    job_folder: Path
    settings: tuple[Setting, ...]
    presets: tuple[Setting, ...]
    targets: Mapping[str, float] | None
    budget_s: float = 900.0
    processes: int = 2


_RAYS = "a ray caster in float64 at the same pixel centres"
_FRONT = "65,536 rays about the objects, and their vertices"
_PATCH = "rays at random in the objects' patch"
_FINEST = "the finest steps, 1 s"
_TRUTH = "the truth of the simulation"
_REFERENCE = "finer steps than any that is measured"


@dataclass(frozen=True)
class ErrorKind:
    """One error: its unit, its name in a few words, its definition, what it is held against, and its part of a scene.

    A scene has one figure of it, and a setting the 95th percentile of its scenes' figures, or where it is `pooled` one
    figure over all its scenes. Less is better.
    """

    name: str
    unit: str
    short: str
    title: str
    truth: str
    group: Group
    pooled: bool = False


# fmt: off
ERRORS = {kind.name: kind for kind in (
    ErrorKind("penetration_mm", "mm", "penetration",
              "how deep an object stands in what it rests on", "the stored shapes", "physics"),
    ErrorKind("gap_mm", "mm", "gap", "how high an object hovers", "the stored shapes", "physics"),
    ErrorKind("unbalanced_share", "", "weight out of balance",
              "share of a weight that contacts leave out of balance", "the stored shapes", "physics"),
    ErrorKind("moved_mm", "mm", "motion when let go again",
              "how far an object moves when it is let go again", _FINEST, "physics"),
    ErrorKind("turned_deg", "deg", "turn when let go again",
              "how far it turns when it is let go again", _FINEST, "physics"),
    ErrorKind("pose_mm", "mm", "pose", "pose off, where two finer settings agree", _REFERENCE, "physics"),
    ErrorKind("outcome_mm", "mm", "where things end, on the whole",
              "how far things slide and roll: two distributions apart", _REFERENCE, "physics", True),
    ErrorKind("outcome_deg", "deg", "how they lie, on the whole",
              "how far things turn: two distributions apart", _REFERENCE, "physics", True),
    ErrorKind("failed_share", "", "scenes that fail", "scenes that do not come to rest", "counted", "physics", True),
    ErrorKind("lost_share", "", "objects that are lost", "objects of the plan that no scene has", "counted", "physics", True),
    ErrorKind("redrawn_share", "", "objects dropped again",
              "objects that left the table and were drawn again, an object", "counted", "physics", True),
    ErrorKind("depth_mm", "mm", "depth of objects", "stored depth of objects off, 99 % of pixels", _RAYS, "labels"),
    ErrorKind("table_depth_mm", "mm", "depth of the table",
              "stored depth of the table off, 99 % of pixels", _RAYS, "labels"),
    ErrorKind("mask_share", "", "the object's mask pixels",
              "object pixels that are wrong in the mask", _RAYS, "labels"),
    ErrorKind("between_mm", "mm", "depth between pixels",
              "depth between pixels, read at the nearest", _PATCH, "labels"),
    ErrorKind("outline_share", "", "regions between pixels",
              "rays at random whose region the nearest pixel has wrong", _PATCH, "labels"),
    ErrorKind("mirror_mm", "mm", "mirror camera", "mirror camera off, as d_z is", _FRONT, "mirror"),
    ErrorKind("agreement_mm", "mm", "agreement of the views",
              "input depth carried into the mirror view, off", "the mirror view", "mirror"),
    ErrorKind("unfilled_share", "", "projected pixels left empty",
              "object pixels of the mirror view seen by both that stay empty", _RAYS, "mirror"),
    ErrorKind("hidden_share", "", "projected pixels that show through",
              "projected pixels that show what the mirror camera cannot see", _RAYS, "mirror"),
    ErrorKind("camera_mm", "mm", "camera position",
              "camera position off, median of a capture's views", _TRUTH, "capture"),
    ErrorKind("camera_deg", "deg", "camera rotation", "camera rotation off, median of its views", _TRUTH, "capture"),
    ErrorKind("cloud_mm", "mm", "merged cloud", "points of the merged cloud off, median", _TRUTH, "capture"),
    ErrorKind("cloud_p95_mm", "mm", "merged cloud, 95 %",
              "points of the merged cloud off, 95 % of them", _TRUTH, "capture"),
    ErrorKind("missing_share", "", "surface that is missing",
              "visible surface without a point within 3 mm", _TRUTH, "capture"),
    ErrorKind("view_depth_mm", "mm", "depth of synthesised views",
              "depth of synthesised views off, median", _TRUTH, "capture"),
    ErrorKind("flip", "", "colour, FLIP", "colour: FLIP, 0 the same to 1", "a converged path-traced image", "colour"),
    ErrorKind("edge_flip", "", "edges, FLIP",
              "smoothness of edges: FLIP, 0 the same to 1", "64 samples a pixel, same light", "colour"),
)}
# fmt: on
"""By name."""

NEGLIGIBLE: Mapping[str, float] = {"mm": 0.02, "deg": 0.02, "": 0.001}
"""By unit: errors below this are as good as none, however they compare."""

# ---------------------------------------------------------------------------------------------- in words


def short(name: str) -> str:
    """An error's name in a few words."""
    return ERRORS[name].short


def unit(name: str) -> str:
    """The unit that an error is shown in: "mm", "deg", "%" for shares, or nothing."""
    return "%" if name.endswith("_share") else ERRORS[name].unit


def shown(name: str, value: float) -> float:
    """An error in the unit that it is shown in."""
    return value * 100.0 if name.endswith("_share") else value


def amount(name: str, value: float) -> str:
    """An error with its unit, three digits: "0.1 mm", "0.25 %"."""
    return f"{number(shown(name, value))} {unit(name)}".strip()


def as_often(ratio: float) -> str:
    """A ratio of times in two digits: "1" within the noise of 5 %, "0.62", "1.6", "47"."""
    return "1" if abs(ratio - 1.0) < 0.05 else number(float(f"{ratio:.2g}"))


def cost(ratio: float) -> str:
    """A ratio of times as a cost: "2 × the time", or "no more time" within the noise."""
    often = as_often(ratio)
    return "no more time" if often == "1" else f"{often} × the time"


def times(ratio: float) -> str:
    """A ratio of times with its word, and a third digit near 1: "1.07 times"."""
    return f"{number(round(ratio, 2)) if 0.9 <= ratio < 1.1 else as_often(ratio)} times"


def listed(words: list[str]) -> str:
    """Words in one phrase: "a", "a and b" or "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)

"""What a study turns and measures: its models, the errors with their truths, the knobs of a job, and how amounts are written.

An error names the truth that it is held against, which is never the setting under test.
"""

import copy
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Any, Literal

from pydantic import ValidationError
from pydantic_core import to_jsonable_python

from schemas.base import set_key
from schemas.errors import InputError, did_you_mean, number
from schemas.job.captures import ESTIMATES
from schemas.job.job import PRESETS, Job, kind_of
from services.job.job_file import describe_fault

Changes = Mapping[str, Any]
"""Values by dotted key of the job, such as {"physics.step_hz": 240}."""

Targets = Mapping[str, float]
"""The greatest allowed value of each error, by name of `ERRORS`, in the unit of the table: shares from 0 to 1."""


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
        return "preset" if self.knob == "preset" else "single" if len(self.parts) == 1 else "several"


OWN = Setting()
"""The job as it is."""


@dataclass(frozen=True)
class Figure:
    """An error of a setting: its value, its 95 % interval by bootstrap over these scenes, and their number.

    The bootstrap knows no scene worse than the worst of its own, so that its ends tell settings of the same scenes apart, and
    say little of other scenes. `least` and `most` bound the error of as many scenes as one likes, each with 95 % confidence.
    """

    value: float
    low: float
    high: float
    least: float
    most: float
    scenes: int

    def verdict(self, target: float) -> Literal["meets", "misses", "open"]:
        """Whether the error of as many scenes as one likes is surely (95 %) at most a target, or surely above it."""
        return "meets" if self.most <= target else "misses" if self.least > target else "open"

    def scaled(self, times: float, most: float) -> "Figure":
        """Times a factor, and at most `most`."""
        ends = {name: getattr(self, name) for name in ("value", "low", "high", "least", "most")}
        return replace(self, **{name: min(most, end * times) for name, end in ends.items()})


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
    targets: Targets
    measured: Mapping[str, Figure]
    promised: Mapping[str, Figure]

    @property
    def missed(self) -> list[str]:
        """The errors whose measured figure is above its target."""
        return [name for name, most in self.targets.items() if not self.measured[name].value <= most]

    @property
    def holds(self) -> bool:
        """Whether every measured figure is at or below its target."""
        return not self.missed


@dataclass(frozen=True)
class Study:
    """The content of a page: the machine, the command, and the table.

    `scenes` is the most that a setting was measured in; `job_scenes` is the size of the whole job; `seconds` were spent of a
    budget of `budget_s`; `chosen` is the name of the setting in the answer, empty where nothing is recommended; `doubts` are
    what is not decided; `notes` hold for the whole study, such as what was not measured, and why.
    """

    job: str
    command: str
    machine: Mapping[str, Any]
    scenes: int
    rows: tuple[Row, ...]
    job_scenes: int
    notes: tuple[str, ...]
    budget_s: float
    seconds: float
    answer: str
    chosen: str
    doubts: tuple[str, ...]
    proofs: tuple[Proof, ...]


_SHAPES = "the stored shapes"
_RAYS = "a ray caster in float64 at the same pixel centres"
_FRONT = "65,536 rays about the objects, and their vertices"
_PATCH = "rays at random in the objects' patch"
_TRUTH = "the truth of the simulation"
_REFERENCE = "finer steps than any that is measured"


@dataclass(frozen=True)
class ErrorKind:
    """One error: its unit, name in a few words, definition, what it is held against, its group, and the usual target.

    A scene has one figure of it, and a setting the 95th percentile of its scenes' figures, or where it is `pooled` one
    figure over all its scenes. Less is better.
    """

    name: str
    unit: str
    short: str
    title: str
    truth: str
    group: Literal["physics", "labels", "mirror", "colour", "capture"]
    target: float | None = None
    pooled: bool = False

    @property
    def negligible(self) -> float:
        """What is as good as none, however it compares."""
        return 0.02 if self.unit else 0.001

    @property
    def most(self) -> float:
        """Shares are at most 1."""
        return float("inf") if self.unit else 1.0


# fmt: off
ERRORS = {row[0]: ErrorKind(*row) for row in (
    ("pose_mm", "mm", "pose", "pose off, where two finer settings agree", _REFERENCE, "physics", 0.1),
    ("outcome_mm", "mm", "where things end, on the whole", "slides and rolls: two distributions apart",
     _REFERENCE, "physics", None, True),
    ("penetration_mm", "mm", "penetration", "how deep an object stands in what it rests on", _SHAPES, "physics", 0.1),
    ("gap_mm", "mm", "gap", "how high an object hovers", _SHAPES, "physics", 0.1),
    ("unbalanced_share", "", "weight out of balance", "share of a weight that contacts leave", _SHAPES, "physics", 0.01),
    ("outcome_deg", "deg", "how they lie, on the whole", "turns: two distributions apart", _REFERENCE, "physics", None, True),
    ("failed_share", "", "scenes that fail", "scenes that do not come to rest", "counted", "physics", None, True),
    ("lost_share", "", "objects that are lost", "planned objects that no scene has", "counted", "physics", None, True),
    ("between_mm", "mm", "depth between pixels", "depth between pixels, read at the nearest", _PATCH, "labels"),
    ("depth_mm", "mm", "depth of objects", "stored depth of objects off, 99 % of pixels", _RAYS, "labels", 0.1),
    ("mask_share", "", "the object's mask pixels", "object pixels that are wrong in the mask", _RAYS, "labels", 0.001),
    ("mirror_mm", "mm", "mirror camera", "mirror camera off, as d_z is", _FRONT, "mirror"),
    ("unfilled_share", "", "projected pixels left empty", "of object pixels that both views see", _RAYS, "mirror"),
    ("hidden_share", "", "projected pixels that show through", "what the mirror camera cannot see", _RAYS, "mirror"),
    ("flip", "", "colour, FLIP", "colour: FLIP, 0 the same to 1", "a converged path-traced image", "colour"),
    ("edge_flip", "", "edges, FLIP", "smoothness of edges: FLIP, 0 the same to 1", "64 samples a pixel, same light", "colour"),
    ("cloud_mm", "mm", "merged cloud", "points of the merged cloud off, median", _TRUTH, "capture", 1.0),
    ("missing_share", "", "surface that is missing", "visible surface without a point within 3 mm", _TRUTH, "capture", 0.05),
    ("view_depth_mm", "mm", "depth of synthesised views", "depth of synthesised views off, median", _TRUTH, "capture", 1.5),
    ("camera_mm", "mm", "camera position", "camera position off, median of a capture's views", _TRUTH, "capture", 0.5),
    ("camera_deg", "deg", "camera rotation", "camera rotation off, median of its views", _TRUTH, "capture", 0.05),
    ("cloud_p95_mm", "mm", "merged cloud, 95 %", "points of the merged cloud off, 95 % of them", _TRUTH, "capture", 3.0),
)}
# fmt: on
"""By name, of each group first those that a picture shows rather."""


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


def times(ratio: float) -> str:
    """A ratio of times in two digits, three near 1: "1.07 times"."""
    return f"{number(round(ratio, 2) if 0.9 <= ratio < 1.1 else float(f'{ratio:.2g}'))} times"


Knobs = Mapping[str, Mapping[str, Changes]]
"""By name, the values of a knob by their labels, from coarse to fine where they have an order."""

REFERENCES = tuple(
    Setting(
        (("reference", name),),
        {"physics.step_hz": hz, "physics.max_step_travel_mm": travel_mm, "physics.solver_iterations": 400},
    )
    for name, hz, travel_mm in (("fine", 3840, 0.03), ("finest", 7680, 0.015))
)
"""Settings of physics finer than every measured value. The first gives the distribution of outcomes; a pose has a truth where
both agree."""


def knobs_of(job: Job) -> Knobs:
    """Every knob, with the values that mean something for this job."""
    if (captures := job.captures) is not None:
        views = [n for n in (4, 6, 10, 20, 40) if n < captures.simulate.views]
        return {
            "views": _values("captures.simulate.views", views),
            # `markers` and `article` estimate each view by itself, `joint` all together.
            "estimate": _values("captures.estimation.estimate", ESTIMATES),
            "iterations": _values("captures.estimation.max_iterations", (1, 2, 5, 20)),
            "voxel": _values("captures.fusion.voxel_m", (0.006, 0.004, 0.002, 0.0015)),
            "merged_views": _values("captures.synthesis.views", (1, 3, 6, 12)),
            "image_scale": _values("captures.simulate.image_scale", (0.25, 0.5, 1.0)),
        }
    rasters = (("flat", "flat", 1), ("raster", "raster", 1), ("raster-4", "raster", 4))
    paths = (1, 4, 16) if find_spec("mitsuba") else ()
    tiers = {
        **{label: {"render.tier": tier, "render.samples": samples} for label, tier, samples in rasters},
        **{f"path-{n}": {"render.tier": "pathtraced", "render.path_samples": n} for n in paths},
    }
    splat, removal = "images.projection.splat", "images.projection.hidden_point_removal"
    return {
        "step": _values("physics.step_hz", (60, 120, 240, 480, 960, 1920)),
        "step_travel": _values("physics.max_step_travel_mm", (1.0, 0.3, 0.1, 0.05, 0.035)),
        "iterations": _values("physics.solver_iterations", (5, 10, 25, 50, 100, 200)),
        "rest": _values("physics.rest.speed_mm_s", (30.0, 10.0, 3.0, 1.0, 0.3)),
        "collision": _values("physics.collision", ("box", "hull", "planned", "parts")),
        "concavity": _values("physics.concavity", (0.2, 0.1, 0.05, 0.02)),
        "exact_rest": {"off": {"physics.exact_rest": False}, "on": {"physics.exact_rest": True}},
        "size": {str(width): resized(job, width) for width in (160, 320, 640, 1280)},
        "units": _values(
            "images.depth_units_per_m",
            [n for n in (1000, 2000, 5000, 8000) if n * job.images.depth_range_m.high <= 65_535],
        ),
        "pivot_depth": _values("cameras.mirror.percentile", (50.0, 10.0, 5.0, 2.0, 0.5, 0.0)),
        "splat": {
            f"{size}{' without backs' if removed else ''}": {splat: size, removal: removed}
            for size, removed in itertools.product((1, 3, 5), (False, True))
        },
        "png_level": _values("images.png_level", (0, 1, 2, 6, 9)),
        "colour": tiers,
    }


def _values(key: str, values: Iterable[float | str]) -> dict[str, Changes]:
    return {value if isinstance(value, str) else f"{value:g}": {key: value} for value in values}


def resized(job: Job, width: int) -> Changes:
    """The job's camera with another number of pixels and the same field of view."""
    sensor = job.cameras.sensor.fixed()
    scaled = {name: value * width / sensor.width for name, value in sensor}
    values = scaled | {"width": width, "height": max(1, round(scaled["height"]))}
    return {f"cameras.sensor.{name}": value for name, value in values.items()}


def choose_knobs(knobs: Knobs, names: Sequence[str] | None) -> Knobs:
    """The knobs with these names, or all for None. Raises InputError for an unknown name."""
    for name in names or ():
        if name not in knobs:
            hint = did_you_mean(name, knobs)
            raise InputError(f"--knobs {name}: there is no such knob; {hint}known: {', '.join(knobs)}")
    return knobs if names is None else {name: knobs[name] for name in names}


def settings_of(job: Job, knobs: Knobs) -> tuple[list[Setting], list[str]]:
    """The job itself, each value of each knob that it does not have itself, and the presets; and what is left out, and why."""
    settings, left_out = [OWN], []
    for knob, values in knobs.items():
        for label, changes in values.items():
            setting = Setting(((knob, label),), changes)
            try:
                if apply(job, changes) != job:
                    settings.append(setting)
            except InputError as error:
                left_out.append(f"{setting.name}: {error}")
    for name, keys in PRESETS[kind_of(job.model_dump(mode="json"))].items():
        if others := {key: value for key, value in keys.items() if apply(job, {key: value}) != job}:
            settings.append(Setting((("preset", name),), others))
    return settings, left_out


def joined(settings: Sequence[Setting]) -> Setting:
    """Several settings at once, of different knobs."""
    parts = tuple(part for setting in settings for part in setting.parts)
    return Setting(parts, {key: value for setting in settings for key, value in setting.changes.items()})


def apply(job: Job, changes: Changes) -> Job:
    """The job with these changes. Raises InputError where the job may not have them."""
    try:
        return Job.model_validate(job_tree_with(changes, job.model_dump(mode="json")))
    except ValidationError as error:
        raise InputError("; ".join(describe_fault(fault) for fault in error.errors())) from error


def job_tree_with(changes: Changes, tree: Mapping[str, Any]) -> dict[str, Any]:
    """Keys and values of a job file, a copy of `tree`, with these changes made: {"physics": {"step_hz": 240}}."""
    made: dict[str, Any] = copy.deepcopy(dict(tree))
    for path, value in changes.items():
        set_key(made, path, to_jsonable_python(value))
    return made

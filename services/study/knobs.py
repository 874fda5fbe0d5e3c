"""The knobs that the study turns, and the settings that it makes of them. Pure."""

import difflib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

from pydantic import ValidationError

from schemas.errors import InputError
from schemas.job.cameras import Sensor as Pinhole
from schemas.job.job import Job
from schemas.job.preset import PRESETS
from services.job.read import describe_fault
from services.study.model import Changes, Group, Knob, Setting, Value

COLOUR_KNOB = "colour"
PATHTRACED = ("path-1", "path-4", "path-16")
"""Labels that need the package of the path-traced tier."""

SPIN_PER_SPEED = 0.01
"""rad/s of `physics.rest.spin_rad_s` for each mm/s of `physics.rest.speed_mm_s`: their defaults' ratio."""

WIDTHS = (160, 320, 640, 1280)
"""Pixels; the other lengths of the pinhole camera go with it."""

_CORRECT = "physics.correction"

_SETTLES = (
    "outcome_mm",
    "outcome_deg",
    "pose_mm",
    "moved_mm",
    "turned_deg",
    "penetration_mm",
    "gap_mm",
    "failed_share",
)
_LABELS = ("depth_mm", "table_depth_mm", "mask_share", "between_mm", "outline_share")
_COLOUR = ("flip", "edge_flip")
_MIRROR = ("mirror_mm", "agreement_mm", "unfilled_share", "hidden_share")


def knobs_of(job: Job) -> tuple[Knob, ...]:
    """Every knob, with the values that mean something for this job."""
    return (*_physics_knobs(job), *_image_knobs(job))


def _physics_knobs(job: Job) -> tuple[Knob, ...]:
    def knob(name: str, title: str, values: Iterable[Value]) -> Knob:
        return Knob(name, title, "physics", _SETTLES, tuple(values))

    return (
        knob("step", "physics steps a second", _plain("physics.step_hz", (60, 120, 240, 480, 960, 1920))),
        knob("step_travel", "travel per step, mm", _plain("physics.max_step_travel_mm", (1.0, 0.3, 0.1, 0.05, 0.035))),
        knob("iterations", "solver iterations", _plain("physics.solver_iterations", (5, 10, 25, 50, 100, 200))),
        knob("rest", "speed that counts as rest, mm/s", map(_rest, (30.0, 10.0, 3.0, 1.0, 0.3))),
        knob("collision", "shape in the simulator", _collisions(job)),
        knob("correction", "final correction", (Value("off", {_CORRECT: False}), Value("on", {_CORRECT: True}))),
    )


def _collisions(job: Job) -> list[Value]:
    """From coarse to fine; parts of meshes from outside at several tolerances (parts of built-in shapes have none).

    The mesh itself is no value: Bullet moves convex shapes alone.
    """
    key, depth = "physics.collision", "physics.concavity"
    found = [Value(name, {key: name}) for name in ("box", "hull", "planned")]
    if all(source.source == "procedural" for source in job.assets.objects):
        return [*found, Value("parts", {key: "parts"})]
    return [*found, *(Value(f"parts to {d:g}", {key: "parts", depth: d}) for d in (0.1, 0.05, 0.02))]


def _image_knobs(job: Job) -> tuple[Knob, ...]:
    units = [n for n in (1000, 2000, 5000, 8000) if n * job.images.depth_range_m.high <= 65_535]
    return (
        Knob("size", "image width, pixels", "labels", _LABELS + _MIRROR, tuple(_size(job, w) for w in WIDTHS)),
        Knob(
            "units",
            "depth units in a metre",
            "labels",
            ("depth_mm", "table_depth_mm", "agreement_mm", "between_mm", "mirror_mm"),
            tuple(_plain("images.depth_units_per_m", units)),
        ),
        Knob("front", "what d_z is read from", "mirror", _MIRROR, _fronts()),
        Knob("splat", "pixels that a projected point fills, and hidden points", "mirror", _MIRROR[2:], _splats()),
        Knob(
            "sensor",
            "depth sensor",
            "labels",
            _LABELS + _MIRROR,
            (
                Value("exact", {"sensor.depth_noise": None}),
                Value("azure-kinect", {"sensor.depth_noise": {}}),
            ),
        ),
        Knob(
            COLOUR_KNOB,
            "render tier and samples",
            "colour",
            ("flip", "edge_flip"),
            _colours(),
            "mitsuba",
            frozenset(PATHTRACED),
        ),
    )


def _plain(key: str, values: Iterable[float]) -> list[Value]:
    return [Value(f"{value:g}", {key: value}) for value in values]


def _rest(speed: float) -> Value:
    changes = {"physics.rest.speed_mm_s": speed, "physics.rest.spin_rad_s": SPIN_PER_SPEED * speed}
    return Value(f"{speed:g}", changes)


def _size(job: Job, width: int) -> Value:
    """The job's camera with another number of pixels: the same picture."""
    sensor = job.cameras.sensor
    scale = width / sensor.width
    values = {
        "width": width,
        "height": max(1, round(sensor.height * scale)),
        **{name: getattr(sensor, name) * scale for name in ("fx", "fy", "cx", "cy")},
    }
    assert set(values) == set(Pinhole.model_fields)
    return Value(str(width), {f"cameras.sensor.{name}": value for name, value in values.items()})


def _fronts() -> tuple[Value, ...]:
    def percentile(p: float) -> Value:
        return Value(f"{p:g}%", {"cameras.mirror.pivot_depth": "percentile", "cameras.mirror.percentile": p})

    return (
        Value("median", {"cameras.mirror.pivot_depth": "median"}),
        *map(percentile, (10.0, 5.0, 2.0, 0.5)),
        Value("nearest", {"cameras.mirror.pivot_depth": "nearest"}),
    )


def _splats() -> tuple[Value, ...]:
    key, removal = "images.projection.splat", "images.projection.hidden_point_removal"
    return tuple(
        Value(f"{size}{' without backs' if removed else ''}", {key: size, removal: removed})
        for size, removed in itertools.product((1, 3, 5), (False, True))
    )


def _colours() -> tuple[Value, ...]:
    return (
        Value("flat", {"render.tier": "flat", "render.samples": 1}),
        Value("raster", {"render.tier": "raster", "render.samples": 1}),
        Value("raster-4", {"render.tier": "raster", "render.samples": 4}),
        *(
            Value(label, {"render.tier": "pathtraced", "render.path_samples": int(label.removeprefix("path-"))})
            for label in PATHTRACED
        ),
    )


def choose_knobs(knobs: Sequence[Knob], names: Sequence[str] | None) -> tuple[Knob, ...]:
    """Those that were asked for, all without a wish. Raises InputError for a name that none has."""
    if names is None:
        return tuple(knobs)
    known = {knob.name: knob for knob in knobs}
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise InputError(f"--knobs {name}: there is no such knob; {hint}known: {', '.join(known)}")
    return tuple(known[name] for name in dict.fromkeys(names))


def settings_of(job: Job, knobs: Sequence[Knob]) -> tuple[tuple[Setting, ...], tuple[str, ...]]:
    """The job itself, then each value of each knob that it does not have itself; and what is left out, and why."""
    settings, left_out = [Setting()], []
    for knob in knobs:
        missing = knob.package is not None and find_spec(knob.package) is None
        if missing:
            labels = ", ".join(value.label for value in knob.values if value.label in knob.needs)
            left_out.append(
                f"{knob.name} {labels}: the package `{knob.package}` is not installed: `./verso extra pathtraced`"
            )
        for value in knob.values:
            if missing and value.label in knob.needs:
                continue
            setting = Setting(((knob.name, value.label),), value.changes)
            try:
                changed = apply(job, value.changes)
            except InputError as error:
                left_out.append(f"{setting.name}: {error}")
                continue
            if changed != job:
                settings.append(setting)
    return tuple(settings), tuple(left_out)


def preset_settings(job: Job) -> tuple[Setting, ...]:
    """The job with each preset's values in place of its own, where that is another job."""
    settings = [Setting((("preset", name),), changes) for name, changes in PRESETS.items()]
    return tuple(setting for setting in settings if apply(job, setting.changes) != job)


def own_label(job: Job, knob: Knob) -> str | None:
    """The label of the value that the job itself has, None where it has another."""
    for value in knob.values:
        try:
            if apply(job, value.changes) == job:
                return value.label
        except InputError:
            continue
    return None


def joined(settings: Sequence[Setting]) -> Setting:
    """Several settings at once, of different knobs."""
    parts = tuple(part for setting in settings for part in setting.parts)
    return Setting(parts, {key: value for setting in settings for key, value in setting.changes.items()})


def apply(job: Job, changes: Changes) -> Job:
    """The job with these keys. Raises InputError where they do not go together with the rest of it."""
    try:
        return Job.model_validate(job_tree_with(changes, job.model_dump(mode="json")))
    except ValidationError as error:
        raise InputError("; ".join(describe_fault(fault) for fault in error.errors())) from error


def job_tree_with(changes: Changes, tree: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Keys and values of a job file with these changes made, nested: {"physics": {"step_hz": 240}}.

    `tree`, if given, is what they are made to; it is left as it is. Raises ValueError where a change's path goes through
    what has no keys.
    """
    made: dict[str, Any] = _copied(tree or {})
    for path, value in changes.items():
        *parents, last = path.split(".")
        place = made
        for key in parents:
            below = place.setdefault(key, {})
            if not isinstance(below, dict):
                raise ValueError(f"{path}: '{key}' is {below!r} and has no keys")
            place = below
        place[last] = _copied(value)
    return made


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copied(below) for key, below in value.items()}
    return [_copied(below) for below in value] if isinstance(value, list | tuple) else value


def groups_of(setting: Setting, knobs: Mapping[str, Knob]) -> frozenset[Group]:
    """Which parts of a scene a setting changes; every part for the job itself and for what is no knob's, such as a preset."""
    if not setting.parts or any(name not in knobs for name, _ in setting.parts):
        return frozenset(("physics", "labels", "mirror", "colour"))
    return frozenset(knobs[name].group for name, _ in setting.parts)

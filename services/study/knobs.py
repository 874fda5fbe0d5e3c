"""The knobs that a study turns, of scenes and of captures, and the settings made of them. Pure."""

import copy
import itertools
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any, get_args

from pydantic import ValidationError
from pydantic_core import to_jsonable_python

from schemas.errors import InputError, did_you_mean
from schemas.job.captures import ESTIMATES
from schemas.job.job import PRESETS, Job, kind_of
from schemas.job.keys import set_key
from schemas.job.views import ViewTarget
from services.job.job_file import describe_fault
from services.study.model import OWN, Changes, Knob, Setting, Value

OTHER_WORLD = frozenset(
    {"friction", "density", "if_lost", "depth_noise", "rgb_noise", "distortion", "exposure", "targets"}
)
"""Knobs whose cost is shown and which are never recommended: they make another world, another camera or other files."""

FREE: Mapping[str, str] = {
    "verso name seed scenes first_scene preset": "says which scenes",
    "run output check": "costs no setting of a scene anything, or is not measured",
    "pairs_per_scene objects_per_scene categories": "what is in a scene: twice as much takes about twice as long",
    "assets.objects assets.tables assets.split assets.shell_kg_m2": "which shapes",
    "start.pose start.offset_m start.arrange start.pile_offset_m start.clearance_m": "where things begin",
    "physics.max_settle_s physics.rest.window_s": "a bound that few scenes reach",
    "physics.rolling_friction physics.spinning_friction physics.restitution": "the world's, as friction is",
    "targets.smooth targets.layers targets.shape targets.points": "which files; their time is in the table of timings",
    "cameras.orbit cameras.depth cameras.mirror.enabled cameras.mirror.T_z_m": "where cameras stand",
    "images.depth_range_m images.patch images.projection.enabled": "which files",
    "render.rgb render.path_bounces": "a whole image, or of the path-traced tier alone",
    "captures.folders captures.board": "what is captured",
    "captures.simulate.distance_m captures.simulate.inclination_rad": "where views are",
    "captures.simulate.tier captures.simulate.depth_noise captures.simulate.rgb_noise captures.simulate.motion_blur "
    "captures.simulate.exposure captures.simulate.distortion captures.simulate.hidden_markers captures.simulate.print_scale "
    "captures.simulate.registration_error captures.simulate.tone_curve captures.simulate.sharpen "
    "captures.simulate.rolling_shutter captures.simulate.jpeg": "the simulated camera, which a real one has anyway",
    "captures.estimation.compare captures.estimation.corner_px captures.estimation.trust captures.estimation.calibrate "
    "captures.fusion.board_clearance_m captures.fusion.min_views": "no time",
}
"""Keys of a job, or branches of keys, that no knob turns, and why. Every other key that costs time is a row of `knobs_of`."""

VIEWS = (4, 6, 10, 20, 40)
"""Numbers of views, as far as the job's captures have as many."""

_FINE = {"step_hz": 3840, "max_step_travel_mm": 0.03, "solver_iterations": 400}
_FINEST = {"step_hz": 7680, "max_step_travel_mm": 0.015, "solver_iterations": 400}

REFERENCES: tuple[Setting, ...] = (
    Setting((("reference", "fine"),), {f"physics.{key}": value for key, value in _FINE.items()}),
    Setting((("reference", "finest"),), {f"physics.{key}": value for key, value in _FINEST.items()}),
)
"""Settings of physics finer than every measured value. The first gives the distribution of outcomes; a pose has a truth where
both agree."""

WIDTHS = (160, 320, 640, 1280)
"""Pixels; the other lengths of the pinhole camera scale with them."""


def knobs_of(job: Job) -> tuple[Knob, ...]:
    """Every knob, with the values that mean something for this job, from coarse to fine where they have an order."""
    if (captures := job.captures) is not None:
        simulated = {
            "views": _values("captures.simulate.views", [n for n in VIEWS if n < captures.simulate.views]),
            # `markers` and `article` estimate each view by itself, `joint` all together.
            "estimate": [Value(name, {"captures.estimation.estimate": name}) for name in ESTIMATES],
            "iterations": _values("captures.estimation.max_iterations", (1, 2, 5, 20)),
            "voxel": _values("captures.fusion.voxel_m", (0.006, 0.004, 0.002, 0.0015)),
            "merged_views": _values("captures.synthesis.views", (1, 3, 6, 12)),
            "image_scale": _values("captures.simulate.image_scale", (0.25, 0.5, 1.0)),
        }
        return tuple(Knob(name, "capture", tuple(values)) for name, values in simulated.items())
    physics = {
        "step": _values("physics.step_hz", (60, 120, 240, 480, 960, 1920)),
        "step_travel": _values("physics.max_step_travel_mm", (1.0, 0.3, 0.1, 0.05, 0.035)),
        "iterations": _values("physics.solver_iterations", (5, 10, 25, 50, 100, 200)),
        "rest": _values("physics.rest.speed_mm_s", (30.0, 10.0, 3.0, 1.0, 0.3)),
        "collision": _collisions(job),
        "concavity": _values("physics.concavity", (0.2, 0.1, 0.05, 0.02)),
        "friction": _values("physics.friction", (0.3, 0.5, 0.7, 1.0)),
        "density": _values("assets.density_kg_m3", (200.0, 600.0, 2000.0)),
        "if_lost": [Value(name, {"start.if_lost": name}) for name in ("fail", "remove", "redraw")],
        "exact_rest": [Value("off", {"physics.exact_rest": False}), Value("on", {"physics.exact_rest": True})],
    }
    units = [n for n in (1000, 2000, 5000, 8000) if n * job.images.depth_range_m.high <= 65_535]
    sensors = {
        "depth_noise": (Value("off", {"sensor.depth_noise": None}), Value("azure-kinect", {"sensor.depth_noise": {}})),
        **{
            name: (Value("off", {f"sensor.{name}": None}), Value("on", {f"sensor.{name}": {}}))
            for name in ("rgb_noise", "distortion", "exposure")
        },
    }
    key, removal = "images.projection.splat", "images.projection.hidden_point_removal"
    splats = [
        Value(f"{size}{' without backs' if removed else ''}", {key: size, removal: removed})
        for size, removed in itertools.product((1, 3, 5), (False, True))
    ]
    return (
        *(Knob(name, "physics", tuple(values)) for name, values in physics.items()),
        Knob("size", "labels", tuple(size_value(job, width) for width in WIDTHS)),
        Knob("units", "labels", tuple(_values("images.depth_units_per_m", units))),
        Knob("pivot_depth", "mirror", tuple(_values("cameras.mirror.percentile", (50.0, 10.0, 5.0, 2.0, 0.5, 0.0)))),
        Knob("splat", "mirror", tuple(splats)),
        *(Knob(name, "labels", values) for name, values in sensors.items()),
        Knob("targets", "labels", tuple(_targets())),
        Knob("png_level", "labels", tuple(_values("images.png_level", (0, 1, 2, 6, 9)))),
        Knob("colour", "colour", _tiers()),
    )


def _values(key: str, values: Iterable[float]) -> list[Value]:
    return [Value(f"{value:g}", {key: value}) for value in values]


def _targets() -> list[Value]:
    names = get_args(ViewTarget)
    asked = ((), *((name,) for name in names), names)
    return [Value(" ".join(some) or "none", {"targets.views": some}) for some in asked]


def _collisions(job: Job) -> list[Value]:
    """From coarse to fine; parts of meshes from outside at several tolerances (parts of built-in shapes have none).

    The mesh itself is no value, because Bullet moves convex shapes alone.
    """
    key, depth = "physics.collision", "physics.concavity"
    found = [Value(name, {key: name}) for name in ("box", "hull", "planned")]
    if all(source.source == "procedural" for source in job.assets.objects):
        return [*found, Value("parts", {key: "parts"})]
    return [*found, *(Value(f"parts to {d:g}", {key: "parts", depth: d}) for d in (0.1, 0.05, 0.02))]


def size_value(job: Job, width: int) -> Value:
    """The job's camera with another number of pixels and the same field of view."""
    sensor = job.cameras.sensor
    scale = width / sensor.width
    scaled = {name: value * scale for name, value in sensor}
    values = scaled | {"width": width, "height": max(1, round(scaled["height"]))}
    return Value(str(width), {f"cameras.sensor.{name}": value for name, value in values.items()})


def _tiers() -> tuple[Value, ...]:
    rasters = (("flat", "flat", 1), ("raster", "raster", 1), ("raster-4", "raster", 4))
    return (
        *(Value(label, {"render.tier": tier, "render.samples": samples}) for label, tier, samples in rasters),
        *(Value(f"path-{n}", {"render.tier": "pathtraced", "render.path_samples": n}, "mitsuba") for n in (1, 4, 16)),
    )


def choose_knobs(knobs: Sequence[Knob], names: Sequence[str] | None) -> tuple[Knob, ...]:
    """The knobs with these names, or all for None. Raises InputError for an unknown name."""
    if names is None:
        return tuple(knobs)
    known = {knob.name: knob for knob in knobs}
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known)
            raise InputError(f"--knobs {name}: there is no such knob; {hint}known: {', '.join(known)}")
    return tuple(known[name] for name in dict.fromkeys(names))


def settings_of(job: Job, knobs: Sequence[Knob]) -> tuple[tuple[Setting, ...], tuple[str, ...]]:
    """The job itself, then each value of each knob that it does not have itself; and what is left out, and why."""
    settings, left_out = [OWN], []
    for knob in knobs:
        missing = [value for value in knob.values if value.package and not find_spec(value.package)]
        if missing:
            labels = ", ".join(value.label for value in missing)
            why = f"the package `{missing[0].package}` is not installed: `./verso extra pathtraced`"
            left_out.append(f"{knob.name} {labels}: {why}")
        for value in [value for value in knob.values if value not in missing]:
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
    """One setting for each preset of the job's kind that makes another job, with the keys that the job has otherwise."""
    presets = PRESETS[kind_of(job.model_dump(mode="json"))]
    changed = {name: {k: v for k, v in keys.items() if apply(job, {k: v}) != job} for name, keys in presets.items()}
    return tuple(Setting((("preset", name),), changes) for name, changes in changed.items() if changes)


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


def job_tree_with(changes: Changes, tree: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Keys and values of a job file, a copy of `tree`, with these changes made: {"physics": {"step_hz": 240}}.

    Raises ValueError where a change's path goes through a value without keys.
    """
    made: dict[str, Any] = copy.deepcopy(dict(tree or {}))
    for path, value in changes.items():
        set_key(made, path, to_jsonable_python(value))
    return made

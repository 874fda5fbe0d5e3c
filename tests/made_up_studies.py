"""Studies of accuracy against time that were made up: rows by hand, and one as large and as noisy as a real one."""

import math
from collections.abc import Mapping

import numpy as np

from services.study.model import ERRORS, Figure, Row, Setting, Study


def figure(value: float, spread: float = 0.1, scenes: int = 48) -> Figure:
    """An error whose interval is `spread` of it to each side."""
    return Figure(value, value * (1 - spread), value * (1 + spread), value * 0.4, scenes)


def row(
    name: str = "", ratio: float = 1.0, noise: float = 0.02, failed: float = 0.0, own_ms: float = 118.0, **errors: float
) -> Row:
    """`row("step=240, tier=flat", 0.8, depth_mm=0.1)`; without a name the job itself."""
    parts = tuple((part.split("=")[0], part.split("=")[1]) for part in name.split(", ")) if name else ()
    setting = Setting(parts, {f"made.{knob}": label for knob, label in parts})
    figures = {error: figure(value) for error, value in errors.items()}
    noise = noise if parts else 0.0
    return Row(setting, own_ms * ratio, ratio, ratio * (1 - noise), ratio * (1 + noise), 235.0, figures, failed)


def study(*rows: Row, job_scenes: int = 64, notes: tuple[str, ...] = ()) -> Study:
    """A study of such rows."""
    machine = {"cpu": "A made-up processor", "cores": 2, "gl_renderer": "llvmpipe", "versions": {"numpy": "2.4.6"}}
    command = "verso tradeoff deploy/jobs/tabletop.yaml --out data/tradeoff"
    return Study("tabletop", command, machine, 48, 500, rows, {"step": 1.02}, "balanced", job_scenes, notes)


# ---------------------------------------------------------------------------------------------- as a real one

OWN = {
    "penetration_mm": 0.0001,
    "gap_mm": 0.0,
    "moved_mm": 0.015,
    "turned_deg": 0.003,
    "pose_mm": 0.2,
    "outcome_mm": 0.21,
    "outcome_deg": 0.4,
    "failed_share": 0.002,
    "depth_mm": 0.1,
    "table_depth_mm": 0.1,
    "mask_share": 0.0,
    "between_mm": 0.9,
    "outline_share": 0.031,
    "mirror_mm": 1.4,
    "agreement_mm": 0.07,
    "unfilled_share": 0.12,
    "hidden_share": 0.06,
    "flip": 0.12,
}
"""The job's own errors, in the size of what was measured."""

OWN_MS = {"physics": 17.0, "render": 52.0, "encode": 26.0, "rest": 23.0}

Turn = tuple[str, dict[str, float], dict[str, float]]
"""A value: its label, what it costs of each stage (times), what becomes of each error (times)."""

TURNS: dict[str, list[Turn]] = {
    "step": [
        (f"{hz} Hz", {"physics": 0.35 + 0.65 * hz / 960}, {name: (960 / hz) ** order for name, order in orders.items()})
        for hz in (120, 240, 480, 1920, 3840)
        for orders in [{"moved_mm": 1.0, "turned_deg": 1.1, "pose_mm": 1.0, "outcome_mm": 0.7, "penetration_mm": 1.5}]
    ],
    "iterations": [
        (str(n), {"physics": 0.7 + 0.3 * n / 50}, {"moved_mm": (50 / n) ** 0.4, "outcome_mm": (50 / n) ** 0.2})
        for n in (10, 20, 100, 200)
    ],
    "rest": [
        (f"{mm} mm/s", {"physics": 1.0 - 0.12 * np.log10(mm)}, {"moved_mm": mm**0.8, "pose_mm": mm**0.3})
        for mm in (0.1, 10.0, 100.0)
    ],
    "shape": [
        ("box", {"physics": 0.8}, {"moved_mm": 90.0, "pose_mm": 40.0, "outcome_mm": 12.0, "gap_mm": 1.0}),
        ("hull", {"physics": 0.9}, {"moved_mm": 3.0, "outcome_mm": 2.2}),
        ("parts 5 %", {"physics": 3.2}, {"moved_mm": 1.2, "outcome_mm": 0.9}),
        ("parts 1 %", {"physics": 6.5}, {"moved_mm": 0.7, "outcome_mm": 0.8}),
        ("mesh", {"physics": 19.0}, {"moved_mm": 0.0, "outcome_mm": 0.0, "pose_mm": 0.0}),
    ],
    "tier": [
        ("flat", {"render": 0.35, "encode": 0.8}, {"flip": 2.3}),
        ("pathtraced", {"render": 215.0}, {"flip": 0.28}),
    ],
    "samples": [(str(n), {"render": 215.0 * n / 16}, {"flip": 0.28 * (16 / n) ** 0.5}) for n in (1, 4, 64, 256)],
    "antialiasing": [("off", {"render": 0.9}, {"flip": 1.15}), ("16", {"render": 1.25}, {"flip": 0.98})],
    "size": [
        (
            f"{w} x {w * 3 // 4}",
            {"render": 0.4 + 0.6 * (w / 640) ** 2, "encode": (w / 640) ** 2},
            {"between_mm": 640 / w, "outline_share": 640 / w, "mirror_mm": 640 / w, "flip": (640 / w) ** 0.5},
        )
        for w in (160, 320, 1280, 1920)
    ],
    "depth units": [
        (
            f"{units} /m",
            {"encode": 0.8 + 0.2 * np.log(units) / np.log(5000)},
            {"depth_mm": 5000 / units, "agreement_mm": 5000 / units},
        )
        for units in (250, 1000, 10000, 20000)
    ],
    "estimator": [
        ("median", {"rest": 0.99}, {"mirror_mm": 5.0}),
        ("mean", {"rest": 0.98}, {"mirror_mm": 9.0}),
        ("min", {"rest": 0.98}, {"mirror_mm": 2.1}),
    ],
    "percentile": [
        (f"{p} %", {"rest": 1.0}, {"mirror_mm": 0.6 + abs(p - 4) * 0.4}) for p in (0.1, 1.0, 3.0, 10.0, 20.0)
    ],
    "projection": [
        ("nearest", {"rest": 0.93}, {"hidden_share": 2.6}),
        ("mesh", {"rest": 1.6}, {"hidden_share": 0.1, "unfilled_share": 0.2}),
    ],
    "splat": [
        (f"{n} px", {"rest": 0.95 + 0.1 * n}, {"unfilled_share": 1.0 / n**1.5, "hidden_share": n**0.6})
        for n in (2, 3, 5)
    ],
    "sensor": [
        ("none", {"rest": 0.9}, {"agreement_mm": 1.0}),
        ("stereo", {"rest": 2.4}, {"agreement_mm": 14.0, "depth_mm": 11.0}),
    ],
}

PAIRS = ((("step", 3), ("estimator", 2)), (("step", 1), ("tier", 0)), (("size", 2), ("depth units", 2)))
PRESETS = {"fast": (("step", 0), ("tier", 0)), "exact": (("step", 4), ("size", 2), ("depth units", 3))}


def large_study(noise_seed: int = 0, noise: float = 0.03) -> Study:
    """Some 55 settings: errors over decades, some 0, some missing. Errors do not depend on the noise, as in a real one."""
    rng = np.random.default_rng(noise_seed)
    singles = [(((knob, turn[0]),), [turn]) for knob, turns in TURNS.items() for turn in turns]
    pairs = [(tuple((k, TURNS[k][n][0]) for k, n in pair), [TURNS[k][n] for k, n in pair]) for pair in PAIRS]
    presets = [((("preset", name),), [TURNS[k][n] for k, n in parts]) for name, parts in PRESETS.items()]
    rows = [_large_row((), [], rng, 0.0)]
    rows += [_large_row(parts, turns, rng, noise) for parts, turns in singles + pairs + presets]
    notes = ("pose_mm: two finer steps do not agree in 31 of 500 scenes, which are left out", "sensor: not of this job")
    return study(*rows, notes=notes)


def _large_row(parts: tuple, turns: list[Turn], rng: np.random.Generator, noise: float) -> Row:
    cost = {stage: ms * math.prod(float(turn[1].get(stage, 1.0)) for turn in turns) for stage, ms in OWN_MS.items()}
    ratio = sum(cost.values()) / sum(OWN_MS.values()) * float(np.exp(rng.normal(0.0, noise)))
    whole = not parts or parts[0][0] == "preset"
    moved = {name for turn in turns for name in turn[2]} if not whole else set(OWN)
    errors = {name: _value(name, turns) for name in OWN if name in moved}
    least, most = (ratio * float(np.exp(way * abs(rng.normal(noise, noise / 3)))) for way in (-1.0, 1.0))
    kilobytes = 235.0 * cost["encode"] / OWN_MS["encode"]
    notes = ("finer steps do not agree in 31 scenes",) if "pose_mm" in errors else ()
    figures = {name: _figure(name, value) for name, value in errors.items()}
    return Row(Setting(parts, _changes(parts)), 118.0 * ratio, ratio, least, most, kilobytes, figures, 0.002, notes)


def _value(name: str, turns: list[Turn]) -> float:
    value = OWN[name]
    for turn in turns:
        value = 9.0 if name == "gap_mm" and turn[0] == "box" else value * turn[2].get(name, 1.0)
    return float(value)


def _figure(name: str, value: float) -> Figure:
    """An interval as wide as the name says, the same in each study."""
    wide = 0.04 + 0.3 * (sum(map(ord, name)) % 10) / 10
    scenes = 500 if ERRORS[name].group == "physics" else 48
    return Figure(value, value * (1 - wide), value * (1 + wide * 1.4), value * 0.3, scenes)


def _changes(parts: tuple) -> Mapping[str, str]:
    return {f"made.{knob.replace(' ', '_')}": label for knob, label in parts}

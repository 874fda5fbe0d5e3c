"""`verso bench captures`: camera poses and clouds of simulated captures against truth, beside those of the usual script."""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from schemas.base import Array, Pose
from schemas.job.job import Job
from schemas.scene.shape import Mesh
from services.bench import marker_script
from services.bench.figures import describe_head, describe_machine
from services.run.progress import ProgressLine
from workers.assets.catalogue import open_catalogue
from workers.capture.folder import open_folder
from workers.capture.process import process_folder
from workers.capture.score import compare_poses, read_whole_truth
from workers.capture.simulate.simulate import load_object, simulate_capture
from workers.geometry.distance import distance_to_mesh
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.chance import SceneChance
from workers.scene.effects import CAPTURE_EFFECTS

COUNT, VIEWS, SEED = 12, 10, 6028
"""Captures, views of each, and their seed, which nothing was tuned on."""

BAR = 5.0
"""Least median over captures of the script's error over ours; and no capture may be below 1."""

LEFT_OUT = ("print_scale", "registration_error", "rolling_shutter")
"""Effects that give both sides wrong data, or a view no single pose; `--set captures.simulate.print_scale=1.01` asks for one."""

LENS = {"k1": 0.08, "k2": -0.05, "p1": 0.0005, "p2": -0.0003}
"""A moderate lens; both sides are given its numbers."""

USUAL = {"motion_blur": 0.008, "sharpen": 1.0, "jpeg": 85, "hidden_markers": 0.15}
"""A careful hand-held camera, and a slip on every seventh marker."""

NO_POSE_MM, NO_POSE_DEG = 1000.0, 180.0
"""Error that a view without a pose counts as, on either side."""


def job_tree() -> dict[str, Any]:
    """Keys of the job whose captures are compared: every effect but `LEFT_OUT`, each as it usually is."""
    effects: dict[str, Any] = {name: {} for name in CAPTURE_EFFECTS if name not in LEFT_OUT}
    simulate = {"views": VIEWS, **effects, **USUAL, "distortion": LENS}
    return {"name": "bench", "seed": SEED, "scenes": COUNT, "captures": {"simulate": simulate}}


def measure_captures(job: Job, folder: Path, count: int) -> dict[str, Any]:
    """Simulate `count` captures below a folder, have both sides process each, and compare them with the truth."""
    catalogue = open_catalogue(job.assets, Path.cwd(), tuple(job.categories))
    rows = []
    with closing(ProgressLine(count, "captures", "capture")) as line:
        for number in range(job.first_scene, job.first_scene + count):
            rows.append(_compare(job, catalogue, SceneChance(job.seed, number), folder / f"{number:05d}"))
            line.show(len(rows))
    assert job.captures is not None
    simulate = job.captures.simulate
    off = [name for name in CAPTURE_EFFECTS if getattr(simulate, name) is None]
    machine = describe_machine(shared_renderer().name)
    return {"machine": machine, "views": simulate.views, "off": off, **summarise(rows)}


def _compare(job: Job, catalogue: Any, chance: SceneChance, path: Path) -> dict[str, Any]:
    """Both sides of one capture: {"object", "ours": errors, by variant of the script: errors}."""
    assert job.captures is not None
    asset = load_object(job, catalogue, chance)
    simulate_capture(job.captures.simulate, job.captures.printed_board, asset, chance, path)
    truth = read_whole_truth(open_folder(path))
    assert truth is not None
    scripts = {name: marker_script.run(path, name) for name in marker_script.REFINEMENTS}
    done = process_folder(path, job.captures)
    ours = {view.number: view.T_board_cam for view in done.estimates.estimate.used if view.T_board_cam is not None}
    sides = {"ours": (ours, done.merged.surface.points, done.seconds["total"]), **scripts}
    return {
        "object": asset.instance_id,
        **{name: errors_of(*side, truth.T_board_cam, truth.surface) for name, side in sides.items()},
    }


def errors_of(
    poses: Mapping[int, Pose], points: Array | None, seconds: float, true: Mapping[int, Pose], surface: Mesh
) -> dict[str, Any]:
    """Median errors of T_board_cam over all true views, of the fused points [N, 3] to the surface, and seconds of processor."""
    each = [compare_poses([poses[n]], [true[n]]) for n in true if n in poses]
    missing = len(true) - len(each)
    cloud = None
    if points is not None and len(points):
        off_mm = 1e3 * np.abs(distance_to_mesh(points, surface)[0])
        cloud = {
            "median_mm": float(np.median(off_mm)),
            "p95_mm": float(np.quantile(off_mm, 0.95)),
            "points": len(points),
        }
    return {
        "pose_mm": median([one.median_mm for one in each] + [NO_POSE_MM] * missing),
        "pose_deg": median([one.median_deg for one in each] + [NO_POSE_DEG] * missing),
        "missing": missing,
        "cloud": cloud,
        "seconds": seconds,
    }


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The rival is the variant of the script with the lower median error; ratios are its errors over ours."""
    by_variant = {name: median(row[name]["pose_mm"] for row in rows) for name in marker_script.REFINEMENTS}
    rival = min(by_variant, key=lambda name: by_variant[name])
    table = [
        {
            **{key: row[key] for key in ("object", "ours")},
            "rival": row[rival],
            "ratio": row[rival]["pose_mm"] / row["ours"]["pose_mm"],
            "ratio_deg": row[rival]["pose_deg"] / row["ours"]["pose_deg"],
        }
        for row in rows
    ]
    ratio = median(row["ratio"] for row in table)
    worse = [number for number, row in enumerate(table) if min(row["ratio"], row["ratio_deg"]) < 1.0]
    return {
        "ok": ratio >= BAR and not worse,
        "rival": rival,
        "variants_mm": by_variant,
        "captures": table,
        "ratio": ratio,
        "ratio_deg": median(row["ratio_deg"] for row in table),
        "worse": worse,
        "bar": BAR,
    }


def describe(figures: dict[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    rows, rival = figures["captures"], figures["rival"]
    fused = all(row["rival"]["cloud"] and row["ours"]["cloud"] for row in rows)
    variants = ", ".join(f"{name} {mm:.3f} mm" for name, mm in figures["variants_mm"].items())
    lines = [
        *describe_head(figures),
        f"measured   {len(rows)} captures of {figures['views']} views, all effects but {', '.join(figures['off'])}",
        f"rival      ArucoDetector with corner refinement {rival}, solvePnP; median of all: {variants}",
        "",
        f"{'median error of poses':28} {'ours':>17} {'rival':>17}   ratio"
        + "   cloud: ours, rival (95 %), mm   s" * fused,
    ]
    for row in rows:
        ours, other = row["ours"], row["rival"]
        missing = f"   without a pose: {ours['missing']} and {other['missing']}" * bool(
            ours["missing"] + other["missing"]
        )
        lines.append(
            f"{row['object']:28} {_pose(ours)} {_pose(other)}  {row['ratio']:6.2f}{_clouds(row) * fused}{missing}"
        )
    lines.append(f"median ratio {figures['ratio']:.2f} of position, {figures['ratio_deg']:.2f} of rotation")
    if not fused:
        lines.append(
            "clouds are not compared: `pip install open3d-cpu` (0.5 GB with what it needs) gives the script its TSDF"
        )
    if not figures["ok"]:
        named = ", ".join(rows[number]["object"] for number in figures["worse"]) or "none"
        lines.append(
            f"missed: the bar is a median ratio of {figures['bar']:g} and no capture below 1; below 1: {named}"
        )
    return lines


def _pose(side: Mapping[str, Any]) -> str:
    return f"{side['pose_mm']:6.3f} mm {side['pose_deg']:6.4f}°"


def _clouds(row: Mapping[str, Any]) -> str:
    ours, other = (row[name]["cloud"] or {"median_mm": math.nan, "p95_mm": math.nan} for name in ("ours", "rival"))
    seconds = " and ".join(f"{row[name]['seconds']:.1f}" for name in ("ours", "rival"))
    words = (f"{one['median_mm']:.2f} ({one['p95_mm']:.2f})" for one in (ours, other))
    return f"   {', '.join(words)}   {seconds}"

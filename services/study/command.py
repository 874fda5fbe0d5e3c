"""`verso tradeoff`: measures a job's settings, chooses one, and writes the table, the plots and the page.

A job of simulated captures has a study of its own: what views, estimates, iterations and voxels cost, and what they give.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from schemas.capture import CaptureScore
from schemas.errors import CaptureError, InputError
from schemas.job.job import Job
from services.bench.command import require_extra
from services.bench.figures import pinned
from services.job.job_file import load_job, read_tree
from services.run.machine import usable_cores
from services.run.progress import ProgressLine
from services.study.choose import answer, parse_targets, recommend
from services.study.colour import colour_truth_missing
from services.study.knobs import apply, choose_knobs, job_tree_with, knobs_of, preset_settings, settings_of
from services.study.measure import context_for, image_figures, timed_rows
from services.study.model import Plan, Row, Setting, Sizes
from services.study.page import write_page, write_tables
from services.study.study import Journal, header_of, run_study, study_of
from workers.assets.catalogue import open_catalogue
from workers.capture.folder import CaptureFolder, open_folder
from workers.capture.make_capture import process_capture, require_captures, simulate_one
from workers.capture.reconstruct import ProcessorClock
from workers.geometry.camera import spread_evenly
from workers.render.raster.context import require_device
from workers.render.tiers import require_tier
from workers.scene.context import WorkerContext, open_worker
from workers.shard.code import code_digest
from workers.store.file_system import temporary_folder

LEAST_SCENES, LEAST_CAPTURES = 4, 2
"""Fewer tell nothing of a 95th percentile, or of how errors of captures spread."""

UNMEASURED = {"check.raycast_share": 0.0, "output.layout": "files"}
"""What no setting is measured with: checks of labels, and tar archives."""


def main(options: argparse.Namespace) -> int:
    """0 where the study is whole and the targets are met. Raises InputError, RunError."""
    require_extra("tradeoff")
    from services.study.plots import write_plots  # draws with matplotlib, of the extra `study`

    targets = parse_targets(options.target) if options.target else None
    asked = load_job(options.job, options.changes)
    plan, left_out = make_plan(asked, options, targets)
    require_tier(plan.job.render)
    catalogue = open_catalogue(plan.job.assets, plan.job_folder, tuple(plan.job.categories))
    context = open_worker(plan.job, catalogue)
    require_device(context.renderer.name, plan.job.run.device, context.renderer.choice)
    header = header_of(plan, context.settings_digest, code_digest())
    with Journal(options.out, header) as journal, closing(ProgressLine(0, "tradeoff", unit="measurement")) as progress:
        if plan.job.captures is not None:
            rows = run_capture_study(plan, journal, context, progress)
        else:
            rows = run_study(plan, journal, context, options.workers or usable_cores(), progress)
    study = study_of(plan, rows, context.renderer.name, shlex.join(["verso", *sys.argv[1:]]), left_out)
    write_tables(study, options.out)
    write_page(study, write_plots(study, options.out), options.out / "index.html", targets)
    for name, order in study.slopes.items():
        print(f"convergence  {name}: error goes with the step to the power {order:.3f}")
    for note in left_out:
        print(f"left out     {note}")
    print(answer(study, targets))
    chosen = recommend(study, targets)
    if options.target:
        write_job(options.job, options.changes, chosen, options.out / "job.yaml", options.target)
        print(f"{options.out / 'job.yaml'}: the job with {chosen.setting.name}")
    if options.json:
        summary = {"chosen": chosen.setting.name, "changes": dict(chosen.setting.changes), "settings": len(study.rows)}
        summary |= {"ok": True, "out": str(options.out), "ms": chosen.ms, "ratio": chosen.ratio}
        print(json.dumps(summary))
    return 0


def make_plan(asked: Job, options: argparse.Namespace, targets: Mapping[str, float] | None) -> tuple[Plan, list[str]]:
    """The plan for these options, and what is left out, and why. Raises InputError."""
    count, captured = min(options.scenes, asked.scenes), asked.captures is not None
    if count < LEAST_SCENES and not captured:
        raise InputError(
            f"{count} scene{'s' * (count > 1)} cannot tell how errors spread: ask for {LEAST_SCENES} or more with --scenes, "
            f"of a job that has as many (scenes: {asked.scenes} in {options.job})"
        )
    unmeasured = {"captures.estimation.compare": False} if captured else UNMEASURED
    job = apply(asked, unmeasured)
    knobs = choose_knobs(knobs_of(job), options.knobs.split(",") if options.knobs else None)
    settings, left_out = settings_of(job, knobs)
    if captured:
        # Presets have no keys of captures.
        sizes = Sizes(scenes=count, settled=0, laps=options.laps)
        plan = Plan(job, options.job.parent, knobs, settings, (), targets, sizes)
        check_captures(plan)
        return plan, []
    missing = colour_truth_missing()
    usual = Sizes()
    limited = {name: min(getattr(usual, name), count) for name in ("posed", "released", "timed")}
    sizes = replace(usual, scenes=count, settled=options.physics_scenes, laps=options.laps, **limited)
    plan = Plan(job, options.job.parent, knobs, settings, preset_settings(job), targets, sizes)
    return plan, [*left_out, *([missing] if missing else [])]


def write_job(source: Path, changes: list[str], row: Row, path: Path, target: str) -> None:
    """Write the user's job file with the chosen keys; its comments are lost."""
    tree = job_tree_with(row.setting.changes, read_tree(source, changes))
    head = f"# {source.name} with {row.setting.name}: the cheapest measured setting with {target}.\n"
    path.write_text(head + yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")


# ---------------------------------------------------------------------------------------------- captures

POINT_BYTES, VERTEX_BYTES, FACE_BYTES = 3 * 4 + 3 * 4 + 3, 3 * 4 + 3, 3 * 4
"""As a cloud and a mesh are written: float32 coordinates and normals, 8-bit colours, 32-bit indices."""

ERRORS_OF_SCORE = {
    "camera_mm": "pose_mm",
    "camera_deg": "pose_deg",
    "cloud_mm": "cloud_median_mm",
    "cloud_p95_mm": "cloud_p95_mm",
    "view_depth_mm": "depth_median_mm",
}
"""Names of the study's errors, and of the score's figures."""


def warm_up(context: WorkerContext, setting: Setting, path: Path) -> None:
    """Process a capture untimed: the first processing in a process compiles its loops. Raises CaptureError."""
    process_capture(open_folder(path), require_captures(context_for(context, setting).job), ProcessorClock())


def measure_capture(
    context: WorkerContext, settings: Sequence[Setting], path: Path, unit: tuple[int, int]
) -> dict[str, Any]:
    """Seconds of processor, bytes and errors by setting of a simulated capture; settings that fail say why.

    Time is that of detection, estimates, cloud and mesh. `unit` is (scene, lap): the order of settings follows from it, so
    that none always follows the same one.
    """
    answer: dict[str, Any] = {"whole": {}, "settling": {}, "bytes": {}, "errors": {}, "failed": {}}
    whole = open_folder(path)
    for setting in [settings[n] for n in np.random.default_rng(unit).permutation(len(settings))]:
        captures = require_captures(context_for(context, setting).job)
        folder = fewer_views(whole, captures.simulate.views)
        watch = ProcessorClock()
        try:
            done = process_capture(folder, captures, watch)
            answer["whole"][setting.name] = sum(s for stage, s in watch.seconds.items() if stage != "score")
            answer["errors"][setting.name] = errors_of(done.score or CaptureScore())
            points, vertices, faces = map(len, (done.surface.points, done.surface.vertices, done.surface.faces))
            answer["bytes"][setting.name] = points * POINT_BYTES + vertices * VERTEX_BYTES + faces * FACE_BYTES
        except CaptureError as error:
            answer["failed"][setting.name] = str(error)
    answer["cold"] = answer["whole"].get(settings[0].name, 0.0)
    return answer


def fewer_views(folder: CaptureFolder, views: int) -> CaptureFolder:
    """The same capture with some of its views only, evenly over the path."""
    return replace(folder, numbers=tuple(folder.numbers[place] for place in spread_evenly(len(folder.numbers), views)))


def errors_of(score: CaptureScore) -> dict[str, float]:
    """The study's errors from a score; what was not measured is left out."""
    found = {name: getattr(score, figure) for name, figure in ERRORS_OF_SCORE.items()}
    found["missing_share"] = None if score.completeness is None else 1.0 - score.completeness
    return {name: float(value) for name, value in found.items() if value is not None}


def check_captures(plan: Plan) -> None:
    """Raises InputError where a job's captures cannot be studied."""
    captures = plan.job.captures
    if captures is None or captures.source != "simulate":
        raise InputError(
            "captures.source is folders: a study needs truth, which simulated captures alone have; use captures.source: simulate"
        )
    if plan.sizes.scenes < LEAST_CAPTURES:
        raise InputError(f"{plan.sizes.scenes} capture cannot tell how errors spread: ask for {LEAST_CAPTURES} or more")


def run_capture_study(plan: Plan, journal: Journal, context: WorkerContext, progress: ProgressLine) -> tuple[Row, ...]:
    """Measure what is not in the journal yet, and make the table; its first row is the job itself.

    A capture is simulated once, and processed with every setting in an order of its own, lap by lap, on one core.
    """
    first, sizes = plan.job.first_scene, plan.sizes
    scenes, laps, warm = range(first, first + sizes.scenes), range(sizes.laps), False
    names = {(scene, lap): f"captures/{scene}/{lap}" for scene in scenes for lap in laps}
    progress.expect(len(names))
    with pinned():
        for scene in scenes:
            missing = [lap for lap in laps if names[scene, lap] not in journal]
            if not missing:
                continue
            with temporary_folder("study") as scratch:
                path = scratch / "capture"
                simulate_one(context, scene, path)
                if not warm:
                    warm_up(context, plan.settings[0], path)
                    warm = True
                for lap in missing:
                    journal.add(names[scene, lap], measure_capture(context, plan.settings, path, (scene, lap)))
                    progress.show(sum(name in journal for name in names.values()))
    return rows_of(plan, [{scene: journal[names[scene, lap]] for scene in scenes} for lap in laps])


def rows_of(plan: Plan, laps: Sequence[Mapping[int, dict[str, Any]]]) -> tuple[Row, ...]:
    """The table, from the answers by lap and capture; settings that no capture could be processed with are left out."""
    answers, rows = list(laps[0].values()), []
    for row, _ in timed_rows(plan.settings, laps):
        name = row.setting.name
        failed = [str(one["failed"][name]) for one in answers if name in one["failed"]]
        errors = image_figures([one["errors"][name] for one in answers if name in one["errors"]])
        notes = tuple(dict.fromkeys(failed))
        rows.append(replace(row, errors=errors, failed_share=len(failed) / len(answers), notes=notes))
    return tuple(rows)

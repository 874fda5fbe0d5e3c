"""`verso tradeoff`: measures a job's settings, chooses one, and writes the table, the plots and the page."""

import argparse
import json
import shlex
import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import yaml

from schemas.errors import InputError
from schemas.job.job import Job
from services.bench.command import require_extra
from services.job.job_file import load_job, read_tree
from services.run.machine import usable_cores
from services.run.progress import ProgressLine
from services.study.captures import check_captures, run_capture_study
from services.study.choose import answer, parse_targets, recommend
from services.study.knobs import apply, choose_knobs, job_tree_with, knobs_of, preset_settings, settings_of
from services.study.measure.colour import colour_truth_missing
from services.study.model import Plan, Row, Sizes
from services.study.report.page import write_page, write_tables
from services.study.study import Journal, header_of, run_study, study_of
from workers.assets.catalogue import open_catalogue
from workers.render.raster.context import require_device
from workers.render.tiers import require_tier
from workers.scene.context import open_worker
from workers.shard.code import code_digest

LEAST_SCENES = 4
"""Fewer tell nothing of a 95th percentile."""


def main(options: argparse.Namespace) -> int:
    """0 where the study is whole and the targets are met. Raises InputError, RunError."""
    require_extra("tradeoff")
    from services.study.report.plots import write_plots  # draws with matplotlib, of the extra `study`

    targets = parse_targets(options.target) if options.target else None
    asked = load_job(options.job, options.changes)
    plan, left_out = make_plan(asked, options, targets)
    require_tier(plan.job.render)
    catalogue = open_catalogue(plan.job.assets, plan.job_folder, tuple(plan.job.categories))
    context = open_worker(plan.job, catalogue)
    require_device(context.renderer.name, plan.job.run.device)
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
    scenes = min(options.scenes, asked.scenes)
    if asked.captures is not None:
        return make_capture_plan(asked, options, targets, scenes), []
    if scenes < LEAST_SCENES:
        raise InputError(
            f"{scenes} scene{'s' * (scenes > 1)} cannot tell how errors spread: ask for {LEAST_SCENES} or more with --scenes, "
            f"of a job that has as many (scenes: {asked.scenes} in {options.job})"
        )
    job = apply(asked, {"check.raycast_share": 0.0, "output.layout": "files"})
    knobs = choose_knobs(knobs_of(job), options.knobs.split(",") if options.knobs else None)
    settings, left_out = settings_of(job, knobs)
    if missing := colour_truth_missing():
        left_out = (*left_out, missing)
    usual = Sizes()
    limited = {name: min(getattr(usual, name), scenes) for name in ("posed", "released", "timed")}
    sizes = replace(usual, scenes=scenes, settled=options.physics_scenes, laps=options.laps, **limited)
    return Plan(job, options.job.parent, knobs, settings, preset_settings(job), targets, sizes), list(left_out)


def make_capture_plan(
    asked: Job, options: argparse.Namespace, targets: Mapping[str, float] | None, captures: int
) -> Plan:
    """The plan for a job of captures; presets have no keys of captures. Raises InputError."""
    job = apply(asked, {"captures.estimation.compare": False})
    knobs = choose_knobs(knobs_of(job), options.knobs.split(",") if options.knobs else None)
    settings, _ = settings_of(job, knobs)
    plan = Plan(
        job, options.job.parent, knobs, settings, (), targets, Sizes(scenes=captures, settled=0, laps=options.laps)
    )
    check_captures(plan)
    return plan


def write_job(source: Path, changes: list[str], row: Row, path: Path, target: str) -> None:
    """Write the user's job file with the chosen keys; its comments are lost."""
    tree = job_tree_with(row.setting.changes, read_tree(source, changes))
    head = f"# {source.name} with {row.setting.name}: the cheapest measured setting with {target}.\n"
    path.write_text(head + yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")

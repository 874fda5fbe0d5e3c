"""`verso tradeoff`: measures, chooses, and writes the table, the plots and the page."""

import argparse
import json
import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from schemas.errors import InputError
from schemas.job.job import Job
from services.bench.extra import require_extra
from services.job.read import load_job, read_tree
from services.run.cores import usable_cores
from services.run.progress import ProgressLine
from services.study.answer import answer, recommend
from services.study.choose import parse_targets
from services.study.journal import Journal
from services.study.knobs import apply, choose_knobs, job_tree_with, knobs_of, preset_settings, settings_of
from services.study.measure.colour_errors import colour_truth_missing
from services.study.measure.process_pool import Crew
from services.study.model import Row
from services.study.plan import Plan, Sizes
from services.study.report.page import write_page
from services.study.report.tables import write_tables
from services.study.study import Progress, header_of, run_study, study_of
from workers.assets.catalogue import open_catalogue
from workers.pipeline.context import open_worker
from workers.pipeline.fingerprint import code_digest
from workers.render.raster.context import require_device
from workers.render.step import require_tier

LEAST_SCENES = 4
"""Fewer say nothing of a 95th percentile."""


def main(options: argparse.Namespace) -> int:
    """0 where the study is whole and the targets are met; raises InputError or RunError otherwise."""
    require_extra("tradeoff")
    from services.study.report.plots import write_plots  # draws with matplotlib, of the extra `study`

    targets = parse_targets(options.target) if options.target else None
    asked = load_job(options.job, options.changes)
    plan, left_out = make_plan(asked, options, targets)
    require_tier(plan.job.render)
    catalogue = open_catalogue(plan.job.assets, plan.job_folder, tuple(plan.job.categories))
    context = open_worker(plan.job, catalogue)
    require_device(context.renderer.name, plan.job.run.device)
    crew = Crew(plan.job, plan.job_folder, options.workers or usable_cores())
    header = header_of(plan, context.settings_digest, code_digest())
    with Journal(options.out, header) as journal, _Bar() as bar:
        rows = run_study(plan, journal, context, crew, bar)
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
        print(json.dumps(_summary(options, chosen, study.rows)))
    return 0


def make_plan(asked: Job, options: argparse.Namespace, targets: Mapping[str, float] | None) -> tuple[Plan, list[str]]:
    """What is measured for these options, and what is left out. Raises InputError."""
    scenes = min(options.scenes, asked.scenes)
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
    sizes = replace(
        usual,
        scenes=scenes,
        posed=min(usual.posed, scenes),
        released=min(usual.released, scenes),
        timed=min(usual.timed, scenes),
        settled=options.physics_scenes,
        laps=options.laps,
    )
    return Plan(job, options.job.parent, knobs, settings, preset_settings(job), targets, sizes), list(left_out)


def write_job(source: Path, changes: list[str], row: Row, path: Path, target: str) -> None:
    """The user's job file with the chosen keys. Comments of the file are not kept."""
    tree = job_tree_with(row.setting.changes, read_tree(source, changes))
    head = f"# {source.name} with {row.setting.name}: the cheapest measured setting with {target}.\n"
    path.write_text(head + yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")


def _summary(options: argparse.Namespace, chosen: Row, rows: tuple[Row, ...]) -> dict[str, Any]:
    return {
        "ok": True,
        "out": str(options.out),
        "chosen": chosen.setting.name,
        "changes": dict(chosen.setting.changes),
        "ms": chosen.ms,
        "ratio": chosen.ratio,
        "settings": len(rows),
    }


class _Bar(Progress):
    """Units on a progress line."""

    def __init__(self) -> None:
        self._asked = self._done = 0
        self._line: ProgressLine | None = None

    def __enter__(self) -> "_Bar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._line is not None:
            self._line.close()

    def expect(self, units: int) -> None:
        self._asked += units
        if self._line is None:
            self._line = ProgressLine(self._asked, "tradeoff", unit="measurement")
        self._line.expect(self._asked)

    def tick(self) -> None:
        self._done += 1
        assert self._line is not None
        self._line.show(self._done)

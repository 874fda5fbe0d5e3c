"""`verso tradeoff`: measures a job's settings within a budget, chooses one, and writes the table, the plots and the page."""

import argparse
import json
import os
import resource
import shlex
import sys
import time
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import yaml

from schemas.errors import MachineError, RunError, describe_seconds
from schemas.job.job import Job
from services.bench.figures import describe_machine
from services.job.job_file import load_job, read_tree
from services.run.machine import usable_cores
from services.run.progress import ProgressLine
from services.study.captures import check_captures
from services.study.choose import Targets, parse_targets, recommend, refuse_unmeasured
from services.study.colour import colour_truth_missing
from services.study.knobs import apply, choose_knobs, job_tree_with, knobs_of, preset_settings, settings_of
from services.study.model import Plan, Row, Study
from services.study.page import describe_proof, write_page, write_tables
from services.study.study import OTHERS, Journal, run_study
from workers.assets.catalogue import open_catalogue
from workers.render.raster.context import require_device
from workers.render.tiers import require_tier
from workers.scene.context import open_worker
from workers.source import code_digest

BUSY = 0.05
"""A study says so where other processes took more than this share of the machine's processor time while it measured."""

UNMEASURED = {"check.raycast_share": 0.0, "output.layout": "files"}
"""What no setting is measured with: checks of labels, and tar archives."""


PACKAGES = {"flip_evaluator": "flip-evaluator", "matplotlib": "matplotlib"}
"""Names on the index by the names that are imported."""


def require_extra() -> None:
    """Raises MachineError, with the remedy, where a package of the extra is not installed."""
    missing = [name for module, name in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise MachineError(
            f"`verso tradeoff` needs {', '.join(missing)}: `./verso extra study` installs what is missing in a checkout; "
            "elsewhere use `pip install --require-hashes -r requirements-study.lock`"
        )


def main(options: argparse.Namespace) -> int:
    """0 where a recommendation held on fresh scenes. Raises InputError, RunError."""
    began = time.monotonic()
    require_extra()
    from services.study.plots import write_plots  # draws with matplotlib, of the extra `study`

    targets = parse_targets(options.target) if options.target else None
    asked = load_job(options.job, options.changes)
    plan, left_out = make_plan(asked, options, targets)
    require_tier(plan.job.render)
    catalogue = open_catalogue(plan.job.assets, plan.job_folder, tuple(plan.job.categories))
    context = open_worker(plan.job, catalogue)
    require_device(context.renderer.name, plan.job.run.device, context.renderer.choice)
    print(f"measures for at most {describe_seconds(plan.budget_s)} (--budget), {plan.processes} scenes at a time")
    journal = Journal(options.out, {"job": context.settings_digest, "code": code_digest()})
    others_s = float(journal.get(OTHERS, 0.0)) - others_seconds()
    about = {"command": shlex.join(["verso", *sys.argv[1:]]), "machine": describe_machine(context.renderer.name)}
    with closing(ProgressLine(round(plan.budget_s), "tradeoff", unit="second")) as progress:
        try:
            study = run_study(plan, journal, progress, began, notes=tuple(left_out), **about)
        finally:
            others_s += others_seconds()
            journal.add(OTHERS, others_s)
    if (share := others_s / (study.seconds * (os.cpu_count() or 1))) > BUSY:
        noisy = f"other processes took {share:.0%} of this machine while it was measured: times are noisy"
        study = replace(study, notes=(*study.notes, noisy))
    write_tables(study, options.out)
    write_page(study, write_plots(study, options.out), options.out / "index.html")
    return tell(study, options, targets)


def tell(study: Study, options: argparse.Namespace, targets: Targets | None) -> int:
    """Prints the notes, the proofs and the answer, and writes the job for targets. Raises RunError."""
    for note in study.notes:
        print(f"note         {note}")
    for doubt in study.doubts:
        print(f"not decided  {doubt}")
    for proof in study.proofs:
        print(f"proof        {describe_proof(proof)}")
    print(study.answer)
    if not study.chosen:
        recommend(study.rows, targets)  # says which target nothing meets
        raise RunError("nothing is recommended: no setting kept the targets on fresh scenes; the page has each")
    chosen = next(row for row in study.rows if row.setting.name == study.chosen)
    if options.target:
        write_job(options.job, options.changes, chosen, options.out / "job.yaml", options.target)
        print(f"{options.out / 'job.yaml'}: the job with {chosen.setting.name}")
    if options.json:
        summary = {"chosen": chosen.setting.name, "changes": dict(chosen.setting.changes), "settings": len(study.rows)}
        summary |= {"ok": True, "out": str(options.out), "ms": chosen.ms, "ratio": chosen.ratio}
        print(json.dumps(summary))
    return 0


def others_seconds() -> float:
    """Processor seconds that all processes took since the machine started, less those of this one and its ended children."""
    # user, nice, system, idle, iowait, irq, softirq, steal: proc_stat(5). What waits takes no processor.
    ticks = [int(word) for word in Path("/proc/stat").read_text().split(maxsplit=9)[1:9]]
    own = sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK") - own


def make_plan(asked: Job, options: argparse.Namespace, targets: Targets | None) -> tuple[Plan, list[str]]:
    """The plan for these options, and what is left out, and why. Raises InputError."""
    captured, missing = asked.captures is not None, colour_truth_missing()
    if captured:
        check_captures(asked)
    refuse_unmeasured(asked, targets or {}, missing)
    job = apply(asked, {"captures.estimation.compare": False} if captured else UNMEASURED)
    knobs = choose_knobs(knobs_of(job), options.knobs.split(",") if options.knobs else None)
    settings, left_out = settings_of(job, knobs)
    presets = preset_settings(job)
    processes = options.workers or usable_cores()
    plan = Plan(job, options.job.parent, settings, presets, targets, options.budget, processes)
    return plan, [*left_out, *([missing] if missing and not captured else [])]


def write_job(source: Path, changes: list[str], row: Row, path: Path, target: str) -> None:
    """Write the user's job file with the chosen keys; its comments are lost."""
    tree = job_tree_with(row.setting.changes, read_tree(source, changes))
    head = f"# {source.name} with {row.setting.name}: the cheapest measured setting with {target}.\n"
    path.write_text(head + yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")

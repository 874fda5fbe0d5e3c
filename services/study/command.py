"""`verso tradeoff`: measures a job's settings within a budget, chooses one, and writes the table, the picture and the page."""

import argparse
import math
import shlex
import sys
import time
from collections.abc import Callable
from contextlib import closing
from importlib.util import find_spec

import yaml

from schemas.errors import InputError, MachineError, RunError, describe_seconds, did_you_mean
from schemas.job.job import Job
from services.bench.figures import describe_machine
from services.job.job_file import load_job, read_tree
from services.run import progress
from services.run.machine import usable_cores
from services.run.progress import ProgressLine
from services.study.choose import recommend
from services.study.model import ERRORS, Study, Targets, apply, choose_knobs, job_tree_with, knobs_of, settings_of
from services.study.study import Journal, Plan, run_study
from services.study.truths import colour_truth_missing
from workers.capture.results import open_sources
from workers.render.raster.context import require_device
from workers.render.tiers import require_tier
from workers.scene.context import open_worker
from workers.source import code_digest

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
    from services.study.page import describe_proof, write_study  # draws with matplotlib, of the extra `study`

    targets = parse_targets(options.target) if options.target else None
    plan, notes = make_plan(load_job(options.job, options.changes), options, targets)
    require_tier(plan.job.render)
    catalogue = open_sources(plan.job, plan.job_folder)
    context = open_worker(plan.job, catalogue)
    require_device(context.renderer.name, plan.job.run.device, context.renderer.choice)
    print(f"measures for at most {describe_seconds(plan.budget_s)} (--budget), {plan.processes} scenes at a time")
    journal = Journal(options.out, {"job": context.settings_digest, "code": code_digest()})
    about = {"command": shlex.join(["verso", *sys.argv[1:]]), "machine": describe_machine(context.renderer.name)}
    with closing(ProgressLine(round(plan.budget_s), "tradeoff", unit="second")) as bar:
        study = run_study(plan, journal, bar, began, notes=notes, **about)
    write_study(study, options.out)
    said = {"note": study.notes, "not decided": study.doubts, "proof": map(describe_proof, study.proofs)}
    for line in (f"{word:12} {line}" for word, lines in said.items() for line in lines):
        print(line)
    print(study.answer)
    return write_job(study, options, targets)


def write_job(study: Study, options: argparse.Namespace, targets: Targets | None) -> int:
    """Writes the job for targets. Raises RunError where nothing is recommended."""
    if not study.chosen:
        recommend(study.rows, targets)  # says which target nothing meets
        raise RunError(f"nothing is recommended: the page has each setting. {study.answer}")
    chosen = next(row for row in study.rows if row.setting.name == study.chosen)
    if options.target:
        tree = job_tree_with(chosen.setting.changes, read_tree(options.job, options.changes))
        head = f"# {options.job.name} with {study.chosen}: the cheapest measured setting with {options.target}.\n"
        path = options.out / "job.yaml"
        path.write_text(head + yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
        print(f"{path}: the job with {study.chosen}, without its comments")
    summary = {"chosen": study.chosen, "changes": dict(chosen.setting.changes), "settings": len(study.rows)}
    return progress.finish(options, True, **summary, out=str(options.out), ms=chosen.ms, ratio=chosen.ratio)


def parse_targets(text: str) -> dict[str, float]:
    """From "penetration_mm=0.1,depth_mm=0.5"; `kept_share` is 1 minus `lost_share`. Raises InputError with the remedy."""
    targets: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = (piece.strip() for piece in part.partition("="))
        if not name or not value:
            raise InputError(f"--target {part.strip() or text!r}: write it as penetration_mm=0.1,depth_mm=0.5")
        try:
            most = float(value)
        except ValueError:
            most = math.nan
        if name == "kept_share":
            name, most = "lost_share", round(1.0 - most, 12)
        if name not in ERRORS:
            raise InputError(
                f"--target {name}: there is no such error; {did_you_mean(name, ERRORS)}Known: {', '.join(ERRORS)}"
            )
        if name in targets:
            raise InputError(f"--target {name}: is given twice, as {targets[name]:g} and as {most:g}")
        if not 0.0 <= most < math.inf:
            raise InputError(f"--target {part.strip()}: must be a number from 0 up, such as 0.001 for 0.1 %")
        targets[name] = most
    return targets


_UNMEASURED: tuple[tuple[Callable[[Job], bool], str, str], ...] = (
    (lambda job: job.captures is None, "capture", "the job has no captures"),
    (lambda job: job.captures is not None, "physics labels mirror colour", "the job is one of captures"),
    (lambda job: not job.cameras.mirror.enabled, "mirror", "cameras.mirror.enabled is false"),
    (lambda job: not job.render.rgb, "colour", "render.rgb is false"),
    (
        lambda job: job.start.pose == "tumbled" or job.objects_per_scene.high > 1,
        "pose_mm",
        "where things end is random when they tumble or meet, so no pose is the true one; ask for outcome_mm",
    ),
)
"""Jobs in which an error, or the errors of some groups, cannot be measured, and why."""


def refuse_unmeasured(job: Job, targets: Targets, missing: str | None) -> None:
    """Raises InputError for a target that no setting of the job can have, before anything is measured.

    `missing` says why this machine has no truth of colour.
    """
    for name in targets:
        for is_so, names, why in _UNMEASURED:
            if is_so(job) and {name, ERRORS[name].group} & set(names.split()):
                raise InputError(f"--target {name}: it cannot be measured here: {why}")
        if name == "flip" and missing is not None:
            raise InputError(f"--target flip: {missing}")


def make_plan(asked: Job, options: argparse.Namespace, targets: Targets | None) -> tuple[Plan, list[str]]:
    """The plan for these options, and what is left out, and why. Raises InputError."""
    if asked.scene == "studio":
        raise InputError(
            "scene is studio: nothing falls, rests or casts a shadow, so no error is traded for time: ask for scenes on a "
            "table, or for captures"
        )
    if asked.scenes_from is not None:
        raise InputError("scenes_from has scenes, and a study draws its own: leave it out")
    missing = colour_truth_missing()
    refuse_unmeasured(asked, targets or {}, missing)
    if (captures := asked.captures) is None:
        job, left_out = apply(asked, UNMEASURED), [missing] if missing else []
    elif captures.folders:
        raise InputError(
            "captures.folders names folders: a study needs truth, which virtual captures alone have; leave it out"
        )
    else:
        job, left_out = apply(asked, {"captures.estimation.compare": False}), []
    knobs = choose_knobs(knobs_of(job), options.knobs.split(",") if options.knobs else None)
    settings, refused = settings_of(job, knobs)
    processes = options.workers or usable_cores()
    return Plan(job, options.job.parent, tuple(settings), targets, options.budget, processes), [*refused, *left_out]

"""The commands and their options, as one table. Handlers are named and not imported, so that `--help` loads nothing heavy."""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.arguments import Parser, read_address, read_counts, read_index, read_listener, read_path, read_place
from services.cli.capture_parser import CAPTURE_COMMANDS
from services.cli.command import JOB, JSON, OUT, SCENE, SET, Command, number, option
from services.cli.queue_parser import QUEUE_COMMANDS

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[Parser]

KEPT: Final = "what is committed is kept, the same command goes on from there"


def build_parser() -> argparse.ArgumentParser:
    """Every command and option.

    `options.handler` names the function of a command as `module:function`; `options.starts_ray(options)` tells whether
    it starts Ray, `options.kept` what remains of its work where it dies, and `options.quiet` whether the terminal is
    spared what C++ code says.
    """
    parser = Parser(
        prog="verso",
        description="View-dependent RGB-D datasets for reconstructing objects from a single view.",
        epilog="`verso COMMAND --help` explains a command and gives an example.",
    )
    parser.add_argument("--version", action="version", version=_version())
    _add_commands(parser.add_subparsers(title="commands", metavar="COMMAND", required=True), COMMANDS)
    return parser


def _add_commands(parsers: "Commands", commands: Mapping[str, Command], above: str = "") -> None:
    """Adds a parser for each command and, below it, for each of its own commands; `above` are the words before them."""
    for name, entry in commands.items():
        words = f"{above}{name}"
        command = parsers.add_parser(
            name,
            help=entry.what,
            description=entry.what[0].upper() + entry.what[1:] + ".",
            epilog=f"example: verso {words} {entry.example}".rstrip(),
        )
        if entry.commands:
            below = command.add_subparsers(title="commands", metavar="COMMAND", required=True)
            _add_commands(below, entry.commands, f"{words} ")
            continue
        for names, settings in (JSON, *entry.options):
            command.add_argument(*names, **settings)
        if entry.one_of:
            group = command.add_mutually_exclusive_group(required=True)
            for names, settings in entry.one_of:
                group.add_argument(*names, **settings)
        handler = entry.handler or f"services.cli.commands:{name}"
        command.set_defaults(handler=handler, starts_ray=entry.starts_ray, kept=entry.kept, quiet=entry.quiet)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"verso {version('verso-data')}"
    except PackageNotFoundError:
        return "verso (a checkout that is not installed)"


COMMANDS: dict[str, Command] = {
    "run": Command(
        "make a dataset, or go on where it stopped",
        "deploy/jobs/tabletop.yaml --scenes 128 --set start.pose=tumbled",
        (
            JOB,
            option("--out", type=read_place, metavar="DIR", help="output folder (default: data/<job name>)"),
            number("--scenes", "how many scenes; more than before extends the dataset"),
            option("--first-scene", type=read_index, metavar="N", help="id of the first scene"),
            number("--workers", "default: the cores this container may use, or the cluster's"),
            number("--shard-size", "scenes in a Ray task, rounded up to whole ranges"),
            option(
                "--address",
                type=read_address,
                metavar="HOST:PORT",
                help="a Ray cluster that runs already (default: a private Ray here)",
            ),
            SET,
            option(
                "--metrics",
                type=read_listener,
                metavar="HOST:PORT",
                help="serve what the run counts to Prometheus there (default: not at all)",
            ),
            option("--dry-run", action="store_true", help="check everything and say what would be done"),
            option(
                "--retry-failed", action="store_true", help="try scenes again that failed for environmental reasons"
            ),
        ),
        starts_ray=lambda options: not options.dry_run,
        kept=KEPT,
        quiet=True,
    ),
    "pack": Command(
        "print a job file as one word that no shell changes, to give it to a cluster in place of the file",
        "deploy/jobs/tabletop.yaml",
        (option("job", type=read_path, metavar="JOB.yaml"),),
    ),
    "status": Command("scenes done, failed and missing; rate; what is running", "data/tabletop", (OUT,)),
    "verify": Command(
        "read every file back and derive the labels again",
        "data/tabletop --independent 16",
        (
            OUT,
            number(
                "--audit",
                "also make N scenes again with the effects that were left out, to prove that they did not matter",
            ),
            number(
                "--independent",
                "also derive the labels of N scenes from the article's definitions, by code that shares nothing with what "
                "made them",
            ),
        ),
    ),
    "query": Command(
        "SQL over the manifests, also while the job runs",
        'data/tabletop "select category, count(*) from scenes group by category"',
        (
            OUT,
            option("sql", metavar="SQL"),
            option("--format", choices=("table", "csv", "parquet", "json"), default="table"),
        ),
    ),
    "replay": Command(
        "make one scene again and compare it with what is stored, or put back what was lost",
        "data/tabletop 17",
        (
            OUT,
            option("scene", type=read_index, metavar="SCENE", nargs="*"),
            option(
                "--repair",
                action="store_true",
                help="put back what is missing or damaged (with SCENEs: in their ranges) where it comes out as it was",
            ),
        ),
    ),
    "scene": Command(
        "write the posed geometry of one scene",
        "data/tabletop 17 --glb scene17.glb",
        (OUT, SCENE, option("--glb", type=read_path, required=True, metavar="FILE")),
    ),
    "capture": Command(
        "real photographs of an object on a marker board: print a board, simulate, import, process, make views, score",
        "process data/mug",
        commands=CAPTURE_COMMANDS,
    ),
    **QUEUE_COMMANDS,
    "test": Command(
        "lint, types, layer rules and tests",
        "tests/hard_cases --figures f.json",
        (option("anything", nargs="*"),),
        "services.cli.selftest:main",
    ),
    "bench": Command(
        "time by stage on one core, beside the script that people write today and the least that is possible",
        "deploy/jobs/tabletop.yaml --scenes 64 --memory 2000 --workers 2",
        (
            option("job", type=read_path, metavar="JOB.yaml", nargs="?", help="default: a job of built-in shapes"),
            number("--scenes", "how many scenes each side makes", 48),
            option(
                "--folder",
                type=read_path,
                metavar="DIR",
                default=Path("data"),
                help="on the disk to measure (default: data)",
            ),
            number("--memory", "also watch one worker's memory over N scenes"),
            number("--workers", "also compare N workers with one, beside N plain processes"),
            number("--scaling-scenes", "how many scenes that comparison makes", 512),
            SET,
            option(
                "--pathtraced",
                nargs="?",
                const=sys.executable,
                metavar="PYTHON",
                help="time the path-traced tier instead, beside Blender's Cycles where PYTHON (default: this one) has bpy",
            ),
            option(
                "--nodes",
                type=read_counts,
                metavar="N,N,...",
                help="measure the coordinator instead, on so many simulated nodes whose scenes only take their time",
            ),
            number(
                "--effects",
                "time settling instead: N scenes by their plan of effects, and with every effect of physics forced",
            ),
        ),
        "services.bench.command:main",
        starts_ray=lambda options: options.workers is not None or options.nodes is not None,
        kept="no figures are kept",
    ),
    "tradeoff": Command(
        "what accuracy costs in time, measured on the job's own scenes",
        "deploy/jobs/tabletop.yaml --out data/tradeoff --target penetration_mm=0.1,depth_mm=0.5",
        (
            JOB,
            option("--out", type=read_path, required=True, metavar="DIR", help="goes on there where it stopped"),
            option(
                "--target",
                metavar="ERROR=MOST,...",
                help="write DIR/job.yaml: the job with the cheapest setting that keeps these errors",
            ),
            option("--knobs", metavar="NAME,...", help="default: all that are known"),
            number("--scenes", "scenes with images (default: 48)", 48),
            number("--physics-scenes", "scenes that only come to rest (default: 500)", 500),
            number("--laps", "rounds of timing (default: 3)", 3),
            number("--workers", "default: the cores this container may use"),
            SET,
        ),
        "services.study.command:main",
    ),
    "doctor": Command("what this machine has, and what is missing", "", (), "services.cli.doctor:main"),
}
"""In the order of `verso --help`. `verso test` is parsed by its own handler: it is here for the list."""

"""The command line's options: one table of commands. Handlers are named, not imported, so that `--help` loads nothing heavy."""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any


def build_parser() -> argparse.ArgumentParser:
    """Every command and option; `options.handler` names the function of a command as `module:function`."""
    parser = argparse.ArgumentParser(
        prog="verso",
        description="View-dependent RGB-D datasets for reconstructing objects from a single view.",
        epilog="`verso COMMAND --help` explains a command and gives an example.",
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, entry in COMMANDS.items():
        command = commands.add_parser(
            name,
            help=entry.what,
            description=entry.what[0].upper() + entry.what[1:] + ".",
            epilog=f"example: verso {name} {entry.example}".rstrip(),
        )
        for names, settings in (JSON, *entry.options):
            command.add_argument(*names, **settings)
        command.set_defaults(handler=entry.handler)
    return parser


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"verso {version('verso-data')}"
    except PackageNotFoundError:
        return "verso (a checkout that is not installed)"


def _index(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up")
    return int(text)


def _count(text: str) -> int:
    value = _index(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 up")
    return value


Option = tuple[tuple[str, ...], dict[str, Any]]


def _option(*names: str, **settings: Any) -> Option:
    return names, settings


def _count_option(name: str, text: str, default: int | None = None) -> Option:
    return _option(name, type=_count, metavar="N", default=default, help=text)


@dataclass(frozen=True)
class Command:
    """A command: what it does, the arguments of an example, `module:function` that runs it, and its options."""

    what: str
    example: str
    handler: str
    options: tuple[Option, ...] = ()


JSON = _option("--json", action="store_true", help="print one JSON object as the last line of standard output")
JOB = _option("job", type=Path, metavar="JOB.yaml")
OUT = _option("out", metavar="OUT")
SCENE = _option("scene", type=_index, metavar="SCENE")
SET = _option("--set", action="append", default=[], metavar="KEY=VALUE", dest="changes", help="change a key of the job")

COMMANDS: dict[str, Command] = {
    "run": Command(
        "make a dataset, or go on where it stopped",
        "deploy/jobs/tabletop.yaml --scenes 128 --set start.pose=tumbled",
        "services.cli.commands:run",
        (
            JOB,
            _option("--out", metavar="DIR", help="output folder (default: data/<job name>)"),
            _count_option("--scenes", "how many scenes; more than before extends the dataset"),
            _option("--first-scene", type=_index, metavar="N", help="id of the first scene"),
            _count_option("--workers", "default: the cores this container may use, or the cluster's"),
            _count_option("--shard-size", "scenes in a Ray task, rounded up to whole ranges"),
            _option(
                "--address", metavar="HOST:PORT", help="a Ray cluster that runs already (default: a private Ray here)"
            ),
            SET,
            _option("--dry-run", action="store_true", help="check everything and say what would be done"),
            _option(
                "--retry-failed", action="store_true", help="try scenes again that failed for environmental reasons"
            ),
        ),
    ),
    "status": Command(
        "scenes done, failed and missing; rate; what is running",
        "data/tabletop",
        "services.cli.commands:status",
        (OUT,),
    ),
    "verify": Command(
        "read every file back and derive the labels again",
        "data/tabletop --independent 16",
        "services.cli.commands:verify",
        (
            OUT,
            _count_option(
                "--audit",
                "also make N scenes again with the effects that were left out, to prove that they did not matter",
            ),
            _count_option(
                "--independent",
                "also derive the labels of N scenes from the article's definitions, by code that shares nothing with what "
                "made them",
            ),
        ),
    ),
    "query": Command(
        "SQL over the manifests, also while the job runs",
        'data/tabletop "select category, count(*) from scenes group by category"',
        "services.cli.commands:query",
        (
            OUT,
            _option("sql", metavar="SQL"),
            _option("--format", choices=("table", "csv", "parquet", "json"), default="table"),
        ),
    ),
    "replay": Command(
        "make one scene again and compare it with what is stored",
        "data/tabletop 17",
        "services.cli.commands:replay",
        (OUT, SCENE),
    ),
    "scene": Command(
        "write the posed geometry of one scene",
        "data/tabletop 17 --glb scene17.glb",
        "services.cli.commands:scene",
        (OUT, SCENE, _option("--glb", type=Path, required=True, metavar="FILE")),
    ),
    "test": Command(
        "lint, types, layer rules and tests",
        "tests/hard_cases --figures f.json",
        "services.cli.selftest:main",
        (_option("anything", nargs="*"),),
    ),
    "bench": Command(
        "time by stage on one core, beside the script that people write today and the least that is possible",
        "deploy/jobs/tabletop.yaml --scenes 64 --memory 2000 --workers 2",
        "services.bench.command:main",
        (
            _option("job", type=Path, metavar="JOB.yaml", nargs="?", help="default: a job of built-in shapes"),
            _count_option("--scenes", "how many scenes each side makes", 48),
            _option(
                "--folder",
                type=Path,
                metavar="DIR",
                default=Path("data"),
                help="on the disk to measure (default: data)",
            ),
            _count_option("--memory", "also watch one worker's memory over N scenes"),
            _count_option("--workers", "also compare N workers with one, beside N plain processes"),
            _count_option("--scaling-scenes", "how many scenes that comparison makes", 512),
            SET,
            _option(
                "--pathtraced",
                nargs="?",
                const=sys.executable,
                metavar="PYTHON",
                help="time the path-traced tier instead, beside Blender's Cycles where PYTHON (default: this one) has bpy",
            ),
            _count_option(
                "--effects",
                "time settling instead: N scenes by their plan of effects, and with every effect of physics forced",
            ),
        ),
    ),
    "tradeoff": Command(
        "what accuracy costs in time, measured on the job's own scenes",
        "deploy/jobs/tabletop.yaml --out data/tradeoff --target penetration_mm=0.1,depth_mm=0.5",
        "services.study.command:main",
        (
            JOB,
            _option("--out", type=Path, required=True, metavar="DIR", help="goes on there where it stopped"),
            _option(
                "--target",
                metavar="ERROR=MOST,...",
                help="write DIR/job.yaml: the job with the cheapest setting that keeps these errors",
            ),
            _option("--knobs", metavar="NAME,...", help="default: all that are known"),
            _count_option("--scenes", "scenes with images (default: 48)", 48),
            _count_option("--physics-scenes", "scenes that only come to rest (default: 500)", 500),
            _count_option("--laps", "rounds of timing (default: 3)", 3),
            _count_option("--workers", "default: the cores this container may use"),
            SET,
        ),
    ),
    "doctor": Command("what this machine has, and what is missing", "", "services.cli.doctor:main"),
}
"""In the order of `verso --help`. `verso test` is parsed by its own handler: it is here for the list."""

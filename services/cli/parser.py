"""The commands and their options, as one table. Handlers are named and not imported, so that `--help` loads nothing heavy."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from services.cli.arguments import (
    Parser,
    read_address,
    read_count,
    read_index,
    read_listener,
    read_path,
    read_place,
    read_span,
)
from services.cli.capture_parser import CAPTURE_COMMANDS
from services.cli.command import JOB, JSON, OUT, SCENE, SET, Command, number, option
from services.cli.init_parser import INIT
from services.cli.queue_parser import QUEUE_COMMANDS
from services.cli.report_parser import REPORT_COMMANDS
from services.cli.study_parser import STUDY_COMMANDS

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[Parser]

EXPORT_FORMATS: Final = ("mirror-recon", "bop", "webdataset", "huggingface", "gltf")
"""Those of services/export/formats.py, which a test compares."""

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
    "init": INIT,
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
    "columns": Command(
        "every column of the tables, with type, unit, frame and meaning",
        "views",
        (option("table", metavar="TABLE", nargs="?", help="scenes, views, objects, ... (default: all)"),),
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
    "sheet": Command(
        "draw a page with images of some scenes of each category",
        "data/tabletop sheet.jpg --scenes 3",
        (
            OUT,
            option("file", type=read_path, metavar="FILE.jpg", help="the picture to write"),
            number("--scenes", "scenes of each category (default: 1)", 1),
            option("--category", metavar="NAME", help="only this one"),
        ),
        "services.read.contact_sheet:main",
    ),
    **REPORT_COMMANDS,
    "export": Command(
        "write the dataset in a layout that other people's loaders read",
        "data/tabletop data/recon --format mirror-recon --category mug",
        (
            OUT,
            option("dir", type=read_place, metavar="DIR", help="a new or an empty folder, or one to go on in"),
            option("--format", choices=EXPORT_FORMATS, required=True, help="docs/export.md describes each"),
            option(
                "--category", action="append", default=[], metavar="NAME", help="only scenes of it; may be repeated"
            ),
            option("--scenes", type=read_span, metavar="FIRST-LAST", help="only scenes with these ids"),
            option("--where", metavar="SQL", help="only scenes for which this holds, such as 'support_margin_mm > 5'"),
            option(
                "--shard-mb",
                type=read_count,
                metavar="N",
                default=256,
                help="size of a file of webdataset and huggingface, 10^6 bytes (default: 256)",
            ),
        ),
        "services.export.export:main",
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
    **STUDY_COMMANDS,
    "doctor": Command("what this machine has, and what is missing", "", (), "services.cli.doctor:main"),
    "completion": Command(
        'print what completes commands and options in a shell: eval "$(verso completion bash)"',
        "bash",
        (option("shell", choices=("bash", "zsh", "tcsh")),),
        "services.cli.completion:main",
    ),
    "extra": Command(
        "install what only some commands need: Mitsuba, MuJoCo as a referee, or the plots of studies",
        "pathtraced",
        (option("name", choices=("pathtraced", "audit", "study")),),
        "services.cli.launcher_commands:extra",
    ),
    "lock": Command(
        "make the lock files of a checkout anew, with the newest versions that pyproject.toml allows",
        "",
        (),
        "services.cli.launcher_commands:lock",
    ),
}
"""In the order of `verso --help`. `verso test` is parsed by its own handler: it is here for the list."""

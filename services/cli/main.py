"""The command line. Thin: it reads arguments, calls one function, prints, and turns errors into exit codes."""

import argparse
import importlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from schemas.errors import VersoError
from services.cli.environment import enter_stack_environment


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 where it is complete, 1 where something is missing or wrong, 2 for wrong input."""
    if argv is None:
        enter_stack_environment()
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["test"]:
        from services.cli.selftest import main as run_tests

        return run_tests(arguments[1:])
    options = build_parser().parse_args(arguments)
    try:
        module, _, function = options.handler.partition(":")
        return int(getattr(importlib.import_module(module), function)(options) or 0)
    except VersoError as error:
        print(f"verso: {error}", file=sys.stderr)
        if getattr(options, "json", False):
            print(json.dumps({"ok": False, "error": str(error), "kind": type(error).__name__}))
        return error.exit_code
    except KeyboardInterrupt:
        print("verso: interrupted; what is committed is kept, the same command goes on from there", file=sys.stderr)
        return 1
    except BrokenPipeError:
        return 1


def build_parser() -> argparse.ArgumentParser:
    """Every command and option. Handlers are named, not imported, so that `--help` loads nothing heavy."""
    parser = argparse.ArgumentParser(
        prog="verso",
        description="View-dependent RGB-D datasets for reconstructing objects from a single view.",
        epilog="`verso COMMAND --help` explains a command and gives an example.",
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_run(commands)
    _add_reading(commands)
    _add_scene_commands(commands)
    test = _command(
        commands, "test", "lint, types, layer rules and tests", "verso test tests/hard_cases --figures f.json"
    )
    test.add_argument("anything", nargs="*")
    _add_bench(commands)
    _add_tradeoff(commands)
    doctor = _command(commands, "doctor", "what this machine has, and what is missing", "verso doctor")
    doctor.set_defaults(handler="services.cli.doctor:main")
    return parser


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"verso {version('verso-data')}"
    except PackageNotFoundError:
        return "verso (a checkout that is not installed)"


def _command(commands: "argparse._SubParsersAction", name: str, what: str, example: str) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        name, help=what, description=what[0].upper() + what[1:] + ".", epilog=f"example: {example}"
    )
    command.add_argument(
        "--json", action="store_true", help="print one JSON object as the last line of standard output"
    )
    return command


def _add_run(commands: "argparse._SubParsersAction") -> None:
    run = _command(
        commands,
        "run",
        "make a dataset, or go on where it stopped",
        "verso run deploy/jobs/tabletop.yaml --scenes 128 --set start.pose=tumbled",
    )
    run.add_argument("job", type=Path, metavar="JOB.yaml")
    run.add_argument("--out", metavar="DIR", help="output folder (default: data/<job name>)")
    run.add_argument("--scenes", type=_count, metavar="N", help="how many scenes; more than before extends the dataset")
    run.add_argument("--first-scene", type=_index, metavar="N", help="id of the first scene")
    run.add_argument(
        "--workers", type=_count, metavar="N", help="default: the cores this container may use, or the cluster's"
    )
    run.add_argument("--shard-size", type=_count, metavar="N", help="scenes in a Ray task, rounded up to whole ranges")
    run.add_argument(
        "--address", metavar="HOST:PORT", help="a Ray cluster that runs already (default: a private Ray here)"
    )
    _add_set(run)
    run.add_argument("--dry-run", action="store_true", help="check everything and say what would be done")
    run.add_argument(
        "--retry-failed", action="store_true", help="try scenes again that failed for environmental reasons"
    )
    run.set_defaults(handler="services.cli.commands:run")


def _add_reading(commands: "argparse._SubParsersAction") -> None:
    status = _command(
        commands, "status", "scenes done, failed and missing; rate; what is running", "verso status data/tabletop"
    )
    status.add_argument("out", metavar="OUT")
    status.set_defaults(handler="services.cli.commands:status")
    verify = _command(
        commands, "verify", "read every file back and derive the labels again", "verso verify data/tabletop"
    )
    verify.add_argument("out", metavar="OUT")
    verify.add_argument(
        "--audit",
        type=_count,
        metavar="N",
        help="also make N scenes again with the effects that were left out, to prove that they did not matter",
    )
    verify.set_defaults(handler="services.cli.commands:verify")
    query = _command(
        commands,
        "query",
        "SQL over the manifests, also while the job runs",
        'verso query data/tabletop "select category, count(*) from scenes group by category"',
    )
    query.add_argument("out", metavar="OUT")
    query.add_argument("sql", metavar="SQL")
    query.add_argument("--format", choices=("table", "csv", "parquet", "json"), default="table")
    query.set_defaults(handler="services.cli.commands:query")


def _add_scene_commands(commands: "argparse._SubParsersAction") -> None:
    replay = _command(
        commands, "replay", "make one scene again and compare it with what is stored", "verso replay data/tabletop 17"
    )
    replay.add_argument("out", metavar="OUT")
    replay.add_argument("scene", type=_index, metavar="SCENE")
    replay.set_defaults(handler="services.cli.commands:replay")
    scene = _command(
        commands, "scene", "write the posed geometry of one scene", "verso scene data/tabletop 17 --glb scene17.glb"
    )
    scene.add_argument("out", metavar="OUT")
    scene.add_argument("scene", type=_index, metavar="SCENE")
    scene.add_argument("--glb", type=Path, required=True, metavar="FILE")
    scene.set_defaults(handler="services.cli.commands:scene")


def _add_bench(commands: "argparse._SubParsersAction") -> None:
    bench = _command(
        commands,
        "bench",
        "time by stage on one core, beside the script that people write today and the least that is possible",
        "verso bench deploy/jobs/tabletop.yaml --scenes 64 --memory 2000 --workers 2",
    )
    bench.add_argument("job", type=Path, metavar="JOB.yaml", nargs="?", help="default: a job of built-in shapes")
    bench.add_argument("--scenes", type=_count, metavar="N", default=48, help="how many scenes each side makes")
    bench.add_argument(
        "--folder", type=Path, metavar="DIR", default=Path("data"), help="on the disk to measure (default: data)"
    )
    bench.add_argument("--memory", type=_count, metavar="N", help="also watch one worker's memory over N scenes")
    bench.add_argument(
        "--workers", type=_count, metavar="N", help="also compare N workers with one, beside N plain processes"
    )
    bench.add_argument(
        "--scaling-scenes", type=_count, metavar="N", default=512, help="how many scenes that comparison makes"
    )
    _add_set(bench)
    bench.add_argument(
        "--pathtraced",
        nargs="?",
        const=sys.executable,
        metavar="PYTHON",
        help="time the path-traced tier instead, beside Blender's Cycles where PYTHON (default: this one) has bpy",
    )
    bench.add_argument(
        "--effects",
        type=_count,
        metavar="N",
        help="time settling instead: N scenes by their plan of effects, and with every effect of physics forced",
    )
    bench.set_defaults(handler="services.bench.command:main")


def _add_tradeoff(commands: "argparse._SubParsersAction") -> None:
    tradeoff = _command(
        commands,
        "tradeoff",
        "what accuracy costs in time, measured on the job's own scenes",
        "verso tradeoff deploy/jobs/tabletop.yaml --out data/tradeoff --target penetration_mm=0.1,depth_mm=0.5",
    )
    tradeoff.add_argument("job", type=Path, metavar="JOB.yaml")
    tradeoff.add_argument("--out", type=Path, required=True, metavar="DIR", help="goes on there where it stopped")
    tradeoff.add_argument(
        "--target",
        metavar="ERROR=MOST,...",
        help="write DIR/job.yaml: the job with the cheapest setting that keeps these errors",
    )
    tradeoff.add_argument("--knobs", metavar="NAME,...", help="default: all that are known")
    tradeoff.add_argument("--scenes", type=_count, metavar="N", default=48, help="scenes with images (default: 48)")
    tradeoff.add_argument(
        "--physics-scenes", type=_count, metavar="N", default=500, help="scenes that only come to rest (default: 500)"
    )
    tradeoff.add_argument("--laps", type=_count, metavar="N", default=3, help="rounds of timing (default: 3)")
    tradeoff.add_argument("--workers", type=_count, metavar="N", help="default: the cores this container may use")
    _add_set(tradeoff)
    tradeoff.set_defaults(handler="services.study.command:main")


def _add_set(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="changes", help="change a key of the job"
    )


def _count(text: str) -> int:
    value = _index(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 up")
    return value


def _index(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())

"""The command line: makes the parser from the table of commands, runs a handler, and turns errors into exit codes."""

import argparse
import importlib
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from schemas.errors import VersoError, command_line, needs_making
from services.cli.arguments import Command, Parser
from services.cli.environment import enter_stack_environment, speak_as_typed, typed_program
from services.cli.rows import COMMANDS, JSON, KEPT, THERE
from services.run.supervisor import supervise, tell_failure

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[Parser]


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns 0 if complete, 1 if something is missing or wrong, 2 for wrong input.

    From the shell (`argv` is None), a command that starts Ray runs under a supervisor.
    """
    from_shell = argv is None
    if argv is None:
        enter_stack_environment()
        speak_as_typed()
        argv = sys.argv[1:]
    options = build_parser(typed_program() if from_shell else "verso").parse_args(argv)
    if from_shell and options.starts_ray(options):
        return supervise(partial(_run, options), options.kept, quiet=options.quiet, answers=options.json)
    try:
        return _run(options)
    except KeyboardInterrupt:
        return _fail(options, f"interrupted; {KEPT}", "Interrupted", 1)


def _fail(options: argparse.Namespace, message: str, kind: str, code: int) -> int:
    tell_failure(message, kind, getattr(options, "json", False))
    return code


def _run(options: argparse.Namespace) -> int:
    """The exit code of a command; errors are told in one line. KeyboardInterrupt passes."""
    speak_as_typed()  # once more: a child of the supervisor has another standard error
    try:
        from services.job.record import require_folder

        for name in options.there:  # before anything is loaded or written
            value = getattr(options, name)
            for place in value if isinstance(value, list) else [value] if value else []:
                require_folder(place)
        module, _, function = options.handler.partition(":")
        with needs_making(f"`{options.command}`"):
            return int(getattr(importlib.import_module(f"..{module}", __package__), function)(options) or 0)
    except VersoError as error:
        message, out = str(error), getattr(options, "out", None)
        if out is not None:  # what reads a file does not know in whose dataset it lies
            message = message.replace("verso verify OUT", command_line("verify", out))
        return _fail(options, message, type(error).__name__, error.exit_code)
    except BrokenPipeError:
        return 1
    except OSError as error:
        from workers.store.file_system import remedy_of

        if (remedy := remedy_of(error)) is None:
            raise
        return _fail(options, f"{error.filename or 'a file'}: {remedy}", type(error).__name__, 1)


def build_parser(program: str = "verso") -> argparse.ArgumentParser:
    """Every command and option of the program, which is called so in usages and examples.

    `options.handler` names the function of a command as `module:function` below `services`, `options.command` is how it is typed;
    `options.starts_ray(options)` tells whether it starts Ray, `options.kept` what remains of its work where it dies, and
    `options.quiet` whether the terminal is spared what C++ code says.
    """
    parser = Parser(
        prog=program,
        description="View-dependent RGB-D datasets for reconstructing objects from a single view.",
        epilog=f"`{program} COMMAND --help` explains a command and gives an example.",
    )
    parser.add_argument("--version", action="version", version=_version())
    _add_commands(parser.add_subparsers(title="commands", metavar="COMMAND", required=True), COMMANDS, f"{program} ")
    return parser


def _add_commands(parsers: "Commands", commands: Mapping[str, Command], above: str) -> None:
    """Adds a parser for each command and, below it, for each of its own commands; `above`: the program and words before."""
    for name, entry in commands.items():
        words = f"{above}{name}"
        command = parsers.add_parser(
            name,
            help=entry.what,
            description=entry.what[0].upper() + entry.what[1:] + ".",
            epilog=f"example: {words} {entry.example}".rstrip(),
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
        handler = entry.handler or f"cli.commands:{name}"
        command.set_defaults(
            command=words,
            handler=handler,
            starts_ray=entry.starts_ray,
            kept=entry.kept,
            quiet=entry.quiet,
            there=[names[0].lstrip("-") for names, settings in entry.options if (names, settings) in THERE],
        )


def _version() -> str:
    for name in ("verso-data", "verso-read"):
        with suppress(PackageNotFoundError):
            return f"verso {version(name)}"
    return "verso (a checkout that is not installed)"


if __name__ == "__main__":
    sys.exit(main())

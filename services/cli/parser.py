"""The parser of the command line, made from the table of commands."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING

from services.cli.arguments import Command, Parser
from services.cli.rows import COMMANDS, JSON

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[Parser]


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

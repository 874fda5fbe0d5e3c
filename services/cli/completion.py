"""`verso completion`: the script that completes commands and options in a shell."""

import argparse

import shtab

from services.cli.arguments import read_job, read_path, read_place
from services.cli.parser import build_parser


def main(options: argparse.Namespace) -> int:
    """Prints the script."""
    print(script_for(options.shell))
    return 0


def script_for(shell: str) -> str:
    """The script for bash, zsh or tcsh, made from the table of commands."""
    parser = build_parser()
    _mark_files(parser)
    return shtab.complete(parser, shell)


def _mark_files(parser: argparse.ArgumentParser) -> None:
    """Let arguments that are files or folders be completed as such."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                _mark_files(below)
        elif action.type in (read_path, read_job):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif action.type is read_place:
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]

"""What is written from the table of commands: docs/commands.md, and the script that completes commands in a shell.

The page: `python -m services.cli.reference > docs/commands.md`.
"""

import argparse
from collections.abc import Iterator, Mapping

import shtab

from services.cli.arguments import Command, read_job, read_path, read_place
from services.cli.main import build_parser
from services.cli.rows import COMMANDS


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


EXIT_CODES = (
    (0, "complete"),
    (1, "it ran, but something is missing or wrong: the message says what, and what to do"),
    (2, "the command line or the job file is wrong: the message names the key, the value and what is allowed"),
)

HEAD = """# Commands

`./verso COMMAND --help` explains every option (installed: `verso`). `--json` ends standard output with one JSON object.
Messages go to standard error. `VERSO_PYTHON` names `.venv`'s Python.

| exit code | meaning |
|---|---|"""


def page() -> str:
    """The whole page, in Markdown."""
    codes = [f"| {code} | {meaning} |" for code, meaning in EXIT_CODES]
    return "\n".join([HEAD, *codes, *_describe(COMMANDS, "")]) + "\n"


def _describe(commands: Mapping[str, Command], above: str) -> Iterator[str]:
    for name, command in commands.items():
        words = f"{above}{name}"
        what = f"{command.what[0].upper()}{command.what[1:]}."
        if command.commands:
            yield from (f"\n## {words}\n", what)
            yield from _describe(command.commands, f"{words} ")
            continue
        yield from (f"\n##{'#' * bool(above)} {words}\n", what, "", f"    ./verso {words} {command.example}".rstrip())


if __name__ == "__main__":
    print(page(), end="")

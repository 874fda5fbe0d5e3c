"""What is written from tables and models: docs/commands.md, docs/job.md, and the script that completes commands in a shell.

The pages: `python -m services.cli.reference NAME > docs/NAME.md`.
"""

import argparse
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import shtab
from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from schemas.base import Counts, Range
from schemas.job.job import Job
from schemas.job.physics import MOST_OBJECTS
from services.cli.arguments import Command, read_job, read_path, read_place
from services.cli.main import build_parser
from services.cli.rows import COMMANDS
from services.job.job_file import models_in


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
Messages go to standard error. Exit codes:
"""


def commands_page() -> str:
    """docs/commands.md."""
    codes = [f"- {code}: {meaning}" for code, meaning in EXIT_CODES]
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


# ------------------------------------------------------------------------------------------------ keys of a job

JOB_HEAD = """\
# Keys of a job file

Written from `schemas/job/` by `python -m services.cli.reference job`. After each key: what is allowed; the default, `null` for
nothing. Other keys and values are refused. `--set physics.step_hz=480` changes a key on the command line.

"""


def list_keys(
    model: type[BaseModel] = Job, prefix: str = "", firsts: dict[type[BaseModel], str] | None = None
) -> Iterator[tuple[str, FieldInfo, str]]:
    """(path, field, path of the same branch before) of every key, depth first; the keys of a branch come once, where it is first.

    Keys of a source have its kind in brackets after the list's name, which stands for the key `source`.
    """
    firsts = {} if firsts is None else firsts
    for name, field in model.model_fields.items():
        path, branches = f"{prefix}{name}", list(models_in(field.annotation))
        before = firsts.get(branches[0], "") if branches else ""
        if name != "source":
            yield path, field, before
        firsts |= dict.fromkeys(() if before else branches, path)
        for branch in () if before else branches:
            yield from list_keys(branch, f"{path}{_kind(branch)}.", firsts)


def _kind(branch: type[BaseModel]) -> str:
    source = branch.model_fields.get("source")
    return "" if source is None else f"[{typing.get_args(source.annotation)[0]}]"


def describe_allowed(field: FieldInfo) -> str:
    """The type and bounds of a field in a few words: `number >0`, `integer >=0,<=1000`."""
    bounds = []
    for bound in field.metadata:
        signs = ((Ge, ">="), (Gt, ">"), (Le, "<="), (Lt, "<"))
        bounds += [
            f"{sign}{getattr(bound, kind.__name__.lower()):g}" for kind, sign in signs if isinstance(bound, kind)
        ]
        if isinstance(bound, MinLen):
            bounds.append(f"at least {bound.min_length}")
    return " ".join([_name(field.annotation), ",".join(bounds)]).strip()


def _name(annotation: Any) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        return "/".join(f"`{value}`" for value in arguments)
    if origin is typing.Annotated:
        return describe_allowed(FieldInfo.from_annotation(annotation))
    if origin in (typing.Union, types.UnionType):
        names = ["`null`" if argument is type(None) else _name(argument) for argument in arguments]
        return " or ".join(dict.fromkeys(names))
    if origin is list:
        return f"list of {_name(typing.get_args(annotation)[0])}"
    if origin is tuple:
        return "list" if Ellipsis in arguments else f"{len(arguments)} numbers"
    if origin is dict or (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
        return "map"
    if annotation is Range:
        return "[low, high]"
    if annotation is Counts:
        return f"integer or [low, high], from 1 to {MOST_OBJECTS}"
    return {int: "integer", float: "number", bool: "`true`/`false`", str: "text"}[annotation]


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return "below"
    if isinstance(value, Range):
        return f"`[{value.low:.6g}, {value.high:.6g}]`"
    if isinstance(value, Counts):
        return f"`{value.low}`" if value.low == value.high else f"`{list(value)}`"
    if isinstance(value, tuple):
        return "one `procedural` source" if value and isinstance(value[0], BaseModel) else f"`{list(value)}`"
    if isinstance(value, dict):
        return "all, equal weights" if value else "`null`"
    if value is None:
        return "`null`"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def job_page() -> str:
    """docs/job.md: every key of a job file with its type, default and meaning, from the models."""
    rows: dict[str, list[str]] = {}
    for path, field, before in list_keys():
        meaning = " ".join([*(field.description or "").split(), *([f"Keys as in `{before}`."] if before else ())])
        default = _default(field)
        allowed = describe_allowed(field).removesuffix(" or `null`" if default == "`null`" else "")
        allowed = "" if default == "below" else f" ({allowed}; {default})"
        rows.setdefault(f"{allowed}: {meaning}\n", []).append(f"`{path}`")
    return JOB_HEAD + "".join(f"- {', '.join(paths)}{row}" for row, paths in rows.items())


if __name__ == "__main__":
    print({"commands": commands_page, "job": job_page}[sys.argv[1]](), end="")

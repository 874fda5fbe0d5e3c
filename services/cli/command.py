"""What a command of the command line is: its words, its options and its handler, and the options that commands share."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from services.cli.arguments import read_count, read_index, read_job, read_place

Option = tuple[tuple[str, ...], dict[str, Any]]


def option(*names: str, **settings: Any) -> Option:
    """An argument of `add_argument`."""
    return names, settings


def number(name: str, text: str, default: int | None = None) -> Option:
    """An option that takes a whole number from 1 up."""
    return option(name, type=read_count, metavar="N", default=default, help=text)


@dataclass(frozen=True)
class Command:
    """A command: what it does, arguments of an example, options, and its handler `module:function` (default: commands.py).

    `one_of`: options of which exactly one is given. `commands`: a command that has these has no handler of its own.
    """

    what: str
    example: str
    options: tuple[Option, ...] = ()
    handler: str = ""
    starts_ray: Callable[[argparse.Namespace], bool] = lambda options: False
    kept: str = ""
    quiet: bool = False
    one_of: tuple[Option, ...] = ()
    commands: Mapping[str, "Command"] = field(default_factory=dict)


JSON = option("--json", action="store_true", help="print one JSON object as the last line of standard output")
JOB = option("job", type=read_job, metavar="JOB.yaml")
OUT = option("out", type=read_place, metavar="OUT")
SCENE = option("scene", type=read_index, metavar="SCENE")
SET = option("--set", action="append", default=[], metavar="KEY=VALUE", dest="changes", help="change a key of the job")

"""What a command of the command line is, and what may be typed for its arguments, checked before anything is done. Pure."""

import argparse
import re
import sys
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NoReturn

from schemas.errors import did_you_mean, plain_line
from services.job.packed import MOST_CHARACTERS, is_packed

JOB_ID: Final = r"j[0-9a-f]{8}"
"""An id of schemas/queue.py, which loads too much for a parser; a test compares the two."""

MOST_PATH_CHARACTERS: Final = 4000
"""Longest name of a file or folder that Linux takes, but for some bytes."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are short, hold no control characters, and name the nearest word that it knows."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Refuses what is too much here, with the usage of the command that it was typed for.

        A command may have two words of which the first is one too: `score` and `score merge`.
        """
        args = sys.argv[1:] if args is None else list(args)
        names = [name for action in self._actions if isinstance(action.choices, Mapping) for name in action.choices]
        if (words := " ".join(args[:2])) in names:
            args[:2] = [words]
        parsed, extras = super().parse_known_args(args, namespace)
        if extras:
            near = did_you_mean(extras[0].partition("=")[0], self._option_string_actions).strip()
            self.error(f"unrecognized arguments: {plain_line(' '.join(extras))}{near and f'; {near}'}")
        return parsed, extras

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = list(map(str, action.choices))
            words = f"invalid choice: {value!r}; {did_you_mean(str(value), known)}choose from {', '.join(known)}"
            raise argparse.ArgumentError(action, words)

    def error(self, message: str) -> NoReturn:
        """Prints the usage and one line, and exits with 2."""
        super().error(plain_line(message, 400))


def refusal(text: str, why: str) -> argparse.ArgumentTypeError:
    """What was typed, short and printable, and what is wrong with it."""
    return argparse.ArgumentTypeError(f"{plain_line(repr(text), 40)}{why}")


def reader(
    pattern: str, why: str, make: Callable[[re.Match[str]], Any] = lambda match: match[0]
) -> Callable[[str], Any]:
    """What reads the values that match a pattern, as `make` has them; None refuses one too. `why`: what is wrong with others."""

    def read(text: str) -> Any:
        match = re.fullmatch(pattern, text, re.ASCII)
        value = None if match is None else make(match)
        if value is None:
            raise refusal(text, why)
        return value

    return read


HOST: Final = r"(?:[\w-]{1,63}(?:\.[\w-]{1,63})*|\[[0-9a-fA-F:.]{2,45}\])"

read_index = reader(r"\d{1,18}", " is not a whole number from 0 up", lambda match: int(match[0]))
read_count = reader(r"0*[1-9]\d{0,17}", " is not a whole number from 1 up", lambda match: int(match[0]))
read_duration = reader(
    r"(?=.*[1-9])(\d{1,6}(?:\.\d{1,3})?)(s|m|h)",
    " is not a time such as 90s, 15m or 2h",
    lambda match: float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2]],
)
read_size = reader(
    r"([1-9]\d{0,2})x([1-9]\d{0,2})",
    " is no size: write COLUMNSxROWS, such as 8x6",
    lambda match: (int(match[1]), int(match[2])),
)
read_length = reader(
    r"\d*\.?\d+(?:e-?\d+)?",
    " is no length in metres up to 10, such as 0.03",
    lambda match: length if 0.0 < (length := float(match[0])) <= 10.0 else None,
)
read_port = reader(
    r"\d{1,5}", " is not a port from 0 to 65535", lambda match: port if (port := int(match[0])) < 65536 else None
)
read_priority = reader(
    r"[+-]?(?:1000|\d{1,3})", " is not a whole number from -1000 to 1000", lambda match: int(match[0])
)
read_job_id = reader(
    JOB_ID, ": an id is a j and eight digits or letters a to f, as `verso submit` prints it and `verso jobs` lists it"
)
read_unit = reader(
    r"(?:([^=]{1,500})=)?(\d{1,9}(?:\.\d{1,12})?(?:e-?\d)?)",
    " is no unit: write metres, such as 0.001 for millimetres, or PATTERN=METRES, such as 'scans/*=0.001'",
    lambda match: (match[1] or "*", float(match[2])) if float(match[2]) else None,
)
read_host = reader(
    rf"{HOST}|[0-9a-fA-F:.]{{2,45}}",
    ": write a name or an address without a port, such as 127.0.0.1 or 0.0.0.0",
    lambda match: match[0].strip("[]"),
)
read_http = reader(
    r"(https?://[^\s/?#@]+(?:/[^\s?#]*)?)",
    ": write it as http://HOST:PORT, as `ray start` prints it for the dashboard (port 8265 by default)",
    lambda match: match[0].rstrip("/"),
)


def _with_port(match: re.Match[str]) -> str | None:
    """An address whose port, if it has one, can be."""
    return match[0] if match[1] is None or 0 < int(match[1]) < 65536 else None


read_listener = reader(
    rf"{HOST}:(\d{{1,5}})",
    ": write it as HOST:PORT, such as 127.0.0.1:9464 (0.0.0.0 listens on every address)",
    _with_port,
)
_read_cluster = reader(
    rf"auto|{HOST}:(\d{{1,5}})", ": write it as HOST:PORT, as `ray start` prints it (port 6379 by default)", _with_port
)


def read_address(text: str) -> str:
    """Where a Ray listens. Raises argparse.ArgumentTypeError."""
    if text.startswith("ray://"):
        remedy = "Verso runs beside a node of the cluster and not through Ray's client: write HOST:PORT (port 6379 by default) on"
        remedy += " a machine of the cluster, or `ray submit CLUSTER.yaml deploy/submit.py JOB` from elsewhere"
        raise refusal(text, f": {remedy}")
    return str(_read_cluster(text))


def read_span(text: str) -> tuple[int, int]:
    """Two ids, FIRST-LAST, both included; one id means itself alone. Raises argparse.ArgumentTypeError."""
    first, dash, last = text.partition("-")
    span = read_index(first), read_index(last if dash else first)
    if span[1] < span[0]:
        raise argparse.ArgumentTypeError(f"{text} ends before it begins: write FIRST-LAST, such as 0-63")
    return span


def read_path(text: str) -> Path:
    """A file or folder. Raises argparse.ArgumentTypeError where none can have that name."""
    return Path(read_place(text))


def read_job(text: str) -> Path:
    """A job file, or a packed one (`job:...`), which may be longer. Raises argparse.ArgumentTypeError."""
    if is_packed(text) and len(text) <= MOST_CHARACTERS and text.isascii() and text.isprintable():
        return Path(text)
    return read_path(text)


def read_place(text: str) -> str:
    """A folder or the address of a bucket. Raises argparse.ArgumentTypeError where none can have that name."""
    hostile = any(unicodedata.category(letter) in ("Cc", "Cs") for letter in text)
    if hostile or not 0 < len(text) <= MOST_PATH_CHARACTERS:
        raise refusal(text, " cannot be the name of a file, folder or bucket")
    return text


Option = tuple[tuple[str, ...], dict[str, Any]]


def option(name: str, shown: str | None, text: str | None = None, kind: Any = None, **settings: Any) -> Option:
    """An argument of `add_argument`: its name, what stands for its value, its help, and what reads it."""
    usual = {"metavar": shown, "help": text, "type": kind}
    return (name,), {key: value for key, value in usual.items() if value is not None} | settings


def number(name: str, text: str, default: int | None = None) -> Option:
    """An option that takes a whole number from 1 up."""
    return option(name, "N", text, read_count, default=default)


def path(name: str, shown: str, text: str | None = None, **settings: Any) -> Option:
    """A file or folder."""
    return option(name, shown, text, read_path, **settings)


def choice(name: str, choices: tuple[str, ...], text: str | None = None, **settings: Any) -> Option:
    """One of some words."""
    return option(name, None, text, choices=choices, **settings)


def flag(name: str, text: str) -> Option:
    """An option that is there or not."""
    return option(name, None, text, action="store_true")


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


def command(what: str, example: str, *options: Option, **more: Any) -> Command:
    """A command with these options; `more` are further fields of it."""
    return Command(what, example, options, **more)

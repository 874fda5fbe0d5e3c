"""What a command of the command line is, and what may be typed for its arguments, checked before anything is done. Pure."""

import argparse
import re
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NoReturn

from schemas.errors import plain_line
from services.job.packed import MOST_CHARACTERS, is_packed

JOB_ID: Final = r"j[0-9a-f]{8}"
"""An id of schemas/queue.py, which loads too much for a parser; a test compares the two."""

MOST_PATH_CHARACTERS: Final = 4000
"""Longest name of a file or folder that Linux takes, but for some bytes."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are short and hold no control characters, whatever was typed."""

    def error(self, message: str) -> NoReturn:
        """Prints the usage and one line, and exits with 2."""
        super().error(plain_line(message, 400))


def refusal(text: str, told: str) -> argparse.ArgumentTypeError:
    """What was typed, short and printable, and what is wrong with it."""
    return argparse.ArgumentTypeError(f"{plain_line(repr(text), 40)}{told}")


def read_index(text: str) -> int:
    """A whole number from 0 up. Raises argparse.ArgumentTypeError."""
    if not (text.isdecimal() and len(text) <= 18):
        raise refusal(text, " is not a whole number from 0 up")
    return int(text)


def read_count(text: str) -> int:
    """A whole number from 1 up. Raises argparse.ArgumentTypeError."""
    if not read_index(text):
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 up")
    return int(text)


def read_duration(text: str) -> float:
    """Seconds, of a number with s, m or h behind it. Raises argparse.ArgumentTypeError."""
    found = re.fullmatch(r"(\d{1,6}(?:\.\d{1,3})?)(s|m|h)", text, re.ASCII)
    if found is None or not float(found[1]):
        raise refusal(text, " is not a time such as 90s, 15m or 2h")
    return float(found[1]) * {"s": 1, "m": 60, "h": 3600}[found[2]]


def read_span(text: str) -> tuple[int, int]:
    """Two ids, FIRST-LAST, both included; one id means itself alone. Raises argparse.ArgumentTypeError."""
    first, dash, last = text.partition("-")
    span = read_index(first), read_index(last if dash else first)
    if span[1] < span[0]:
        raise argparse.ArgumentTypeError(f"{text} ends before it begins: write FIRST-LAST, such as 0-63")
    return span


def read_size(text: str) -> tuple[int, int]:
    """Two counts, 8x6. Raises argparse.ArgumentTypeError."""
    if not (found := re.fullmatch(r"([1-9][0-9]{0,2})x([1-9][0-9]{0,2})", text, re.ASCII)):
        raise refusal(text, " is no size: write COLUMNSxROWS, such as 8x6")
    return int(found[1]), int(found[2])


def read_length(text: str) -> float:
    """A length in metres, up to 10. Raises argparse.ArgumentTypeError."""
    if not re.fullmatch(r"[0-9]*\.?[0-9]+(e-?[0-9]+)?", text, re.ASCII) or not 0.0 < float(text) <= 10.0:
        raise refusal(text, " is no length in metres, such as 0.03")
    return float(text)


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


def read_address(text: str) -> str:
    """Where a Ray listens. Raises argparse.ArgumentTypeError."""
    if text.startswith("ray://"):
        told = "Verso runs beside a node of the cluster and not through Ray's client: write HOST:PORT (port 6379 by default) on"
        told += " a machine of the cluster, or `ray submit CLUSTER.yaml deploy/submit.py JOB` from elsewhere"
        raise refusal(text, f": {told}")
    host = r"[\w-]{1,63}(?:\.[\w-]{1,63})*|\[[0-9a-fA-F:.]{2,45}\]"
    found = re.fullmatch(rf"(?:{host}):(\d{{1,5}})", text, re.ASCII)
    if text != "auto" and not (found and 0 < int(found[1]) < 65536):
        told = "write it as HOST:PORT, as `ray start` prints it (port 6379 by default)"
        raise refusal(text, f": {told}")
    return text


def read_listener(text: str) -> str:
    """An address of this machine and a port to listen on, HOST:PORT. Raises argparse.ArgumentTypeError."""
    told = "write it as HOST:PORT, such as 127.0.0.1:9464 (0.0.0.0 listens on every address)"
    if text == "auto" or text.startswith("ray://"):
        raise argparse.ArgumentTypeError(f"{text}: {told}")
    try:
        return read_address(text)
    except argparse.ArgumentTypeError:
        raise refusal(text, f": {told}") from None


def read_port(text: str) -> int:
    """A port, or 0 for any that is free. Raises argparse.ArgumentTypeError."""
    if read_index(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text} is not a port from 0 to 65535")
    return int(text)


def read_host(text: str) -> str:
    """A name or an address to listen on, without a port. Raises argparse.ArgumentTypeError."""
    bare = text.removeprefix("[").removesuffix("]")
    if not re.fullmatch(r"[\w-]{1,63}(?:\.[\w-]{1,63})*|[0-9a-fA-F:.]{2,45}", bare, re.ASCII):
        told = "write a name or an address without a port, such as 127.0.0.1 or 0.0.0.0"
        raise refusal(text, f": {told}")
    return bare


def read_http(text: str) -> str:
    """The address of an HTTP server. Raises argparse.ArgumentTypeError."""
    if not re.fullmatch(r"https?://[^\s/?#@]+(?:/[^\s?#]*)?", text, re.ASCII):
        told = "write it as http://HOST:PORT, as `ray start` prints it for the dashboard (port 8265 by default)"
        raise refusal(text, f": {told}")
    return text.rstrip("/")


def read_job_id(text: str) -> str:
    """The id of a job in a queue. Raises argparse.ArgumentTypeError."""
    if not re.fullmatch(JOB_ID, text, re.ASCII):
        told = "an id is a j and eight digits or letters a to f, as `verso submit` prints it and `verso jobs` lists it"
        raise refusal(text, f": {told}")
    return text


def read_priority(text: str) -> int:
    """A whole number from -1000 to 1000. Raises argparse.ArgumentTypeError."""
    if not re.fullmatch(r"[+-]?[0-9]{1,4}", text, re.ASCII) or abs(int(text)) > 1000:
        raise refusal(text, " is not a whole number from -1000 to 1000")
    return int(text)


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

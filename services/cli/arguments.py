"""What is typed for an argument, checked before anything is done with it. Pure."""

import argparse
import re
import unicodedata
from pathlib import Path
from typing import Final, NoReturn

from schemas.plain_line import plain_line
from services.job.packed import MOST_CHARACTERS, is_packed

MOST_PATH_CHARACTERS: Final = 4000
"""Longest name of a file or folder that Linux takes, but for some bytes."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are short and hold no control characters, whatever was typed."""

    def error(self, message: str) -> NoReturn:
        """Prints the usage and one line, and exits with 2."""
        super().error(plain_line(message, 400))


def read_index(text: str) -> int:
    """A whole number from 0 up. Raises argparse.ArgumentTypeError."""
    if not (text.isdecimal() and len(text) <= 18):
        raise argparse.ArgumentTypeError(f"{plain_line(repr(text), 40)} is not a whole number from 0 up")
    return int(text)


def read_count(text: str) -> int:
    """A whole number from 1 up. Raises argparse.ArgumentTypeError."""
    if not read_index(text):
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 up")
    return int(text)


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
    if (
        not text
        or len(text) > MOST_PATH_CHARACTERS
        or any(unicodedata.category(letter) in ("Cc", "Cs") for letter in text)
    ):
        raise argparse.ArgumentTypeError(f"{plain_line(repr(text), 40)} cannot be the name of a file, folder or bucket")
    return text


def read_address(text: str) -> str:
    """Where a Ray listens. Raises argparse.ArgumentTypeError."""
    if text.startswith("ray://"):
        told = "Verso runs beside a node of the cluster and not through Ray's client: write HOST:PORT (port 6379 by default) on"
        told += " a machine of the cluster, or `ray submit CLUSTER.yaml deploy/submit.py JOB` from elsewhere"
        raise argparse.ArgumentTypeError(f"{plain_line(repr(text), 40)}: {told}")
    host = r"[\w-]{1,63}(?:\.[\w-]{1,63})*|\[[0-9a-fA-F:.]{2,45}\]"
    found = re.fullmatch(rf"(?:{host}):(\d{{1,5}})", text, re.ASCII)
    if text != "auto" and not (found and 0 < int(found[1]) < 65536):
        told = "write it as HOST:PORT, as `ray start` prints it (port 6379 by default)"
        raise argparse.ArgumentTypeError(f"{plain_line(repr(text), 40)}: {told}")
    return text

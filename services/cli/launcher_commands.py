"""Commands that are the launcher's: named in `--help`, and explained where Verso was not started by it."""

import argparse

from schemas.errors import InputError


def extra(options: argparse.Namespace) -> int:
    """`verso extra`. Raises InputError: the launcher has done it before, or there is none."""
    raise InputError(
        f"extra {options.name} is installed by `./verso` in a checkout; elsewhere: pip install 'verso-data[{options.name}]'"
    )


def lock(options: argparse.Namespace) -> int:
    """`verso lock`. Raises InputError: only the launcher of a checkout can do it."""
    raise InputError("lock makes a checkout's lock files: type ./verso lock there")

"""Who is told how far the listing and the check of files are."""

from collections.abc import Callable

Watch = Callable[[str, int, int], None]
"""Is told what is being done, and with how many of how many files."""


def ignore(what: str, done: int, asked: int) -> None:
    """A watch that says nothing."""

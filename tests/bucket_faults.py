"""Counting the requests that a program makes to an object store, and ending or disturbing it at any one of them.

A kill is an exception that nothing catches, and every later request raises it again, as after a real kill.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

import obstore
import pytest
from obstore.exceptions import GenericError

from tests.disk_faults import Killed
from workers.store import objects

CHANGES = ("put", "copy", "delete")
REQUESTS = (*CHANGES, "get", "head", "list", "list_with_delimiter")

Fault = Literal["killed before", "killed after", "answer lost"]


class Requests:
    """`obstore`, with its requests counted; number `at` meets the fault, or `then` runs just before it."""

    def __init__(self, names: tuple[str, ...], at: int, fault: Fault, then: Callable[[], object] | None) -> None:
        self.count = 0
        self.decision = -1
        """The number of the latest conditional put."""
        self.names = names
        self.at = at
        self._fault = fault
        self._then = then
        self._busy = False
        self._counting = threading.Lock()

    def __getattr__(self, name: str):
        real = getattr(obstore, name)
        return self._watched(real) if name in self.names else real

    def _watched(self, real: Callable) -> Callable:
        def call(*arguments, **named):
            if self._busy:
                return real(*arguments, **named)
            with self._counting:
                mine = self.count
                self.count += 1
                if named.get("mode") == "create":
                    self.decision = mine
            if mine == self.at and self._then is not None:
                self._run_then()
            elif self._then is None and -1 < self.at <= mine and self._fault != "answer lost":
                if mine == self.at and self._fault == "killed after":
                    real(*arguments, **named)
                raise Killed
            elif mine == self.at and self._then is None:
                real(*arguments, **named)
                raise GenericError("the answer was lost")
            return real(*arguments, **named)

        return call

    def _run_then(self) -> None:
        assert self._then is not None
        self._busy = True
        try:
            self._then()
        finally:
            self._busy = False


@contextmanager
def requests(
    at: int = -1,
    fault: Fault = "killed before",
    then: Callable[[], object] | None = None,
    names: tuple[str, ...] = CHANGES,
) -> Iterator[Requests]:
    """Counts the requests with these names in this context; number `at` meets the fault, or `then` runs before it."""
    watched = Requests(names, at, fault, then)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objects, "obstore", watched)
        yield watched

"""Parameters of which the first few run in every suite, and the others later: with --ci, or with --all."""

from collections.abc import Iterable
from typing import Any

import pytest


def first_of(values: Iterable[Any], count: int, in_ci: int | None = None) -> list[Any]:
    """The first `count` run by default, those up to `in_ci` (all, without a number) with --ci, and the others with --all."""

    def marks(place: int) -> list[pytest.MarkDecorator]:
        if place < count:
            return []
        return [pytest.mark.minute if in_ci is None or place < in_ci else pytest.mark.slow]

    return [pytest.param(value, marks=marks(place)) for place, value in enumerate(values)]

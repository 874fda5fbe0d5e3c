"""Hard cases that the program does not meet yet, with what was seen; each is in the table as any other, and must go from here."""

from typing import Any

import pytest

WAITING: dict[str, str] = {
    "needle of 0.2 by 200 mm dropped at 60 degrees": "it falls through the table: thinner than Bullet's contacts are exact",
    "can spun upright at 200 rad/s": "its rim goes 0.4 mm in the shortest step, over sides 4 mm wide: it falls over",
    "pile of a hundred boxes": "no result in 40 s",
    "eight balls poured into a tray": "no result in 40 s",
    "needle of 0.2 by 200 mm tumbled": "it falls through the table: two seeds of two",
    "stack of twenty-five cubes": "no result in 90 s",
    "stack of ten cubes": "half a millimetre falls between each two: the top lands 1.2 mm aside, and 1 mm is allowed",
}
"""What ends otherwise than declared, and how."""

MOVES: dict[str, str] = {
    "cube of 2 mm from 1 m": "it turns by 0.14 degrees: 0.01 mm at a corner",
    "cube against a wall, 4 degrees inside of what friction holds": "it slips by 0.5 mm: Bullet's friction is a little off",
}
"""What moves by more than 0.1 mm or 0.1 degrees in the second after it is let go again."""


def marks_of(name: str, again: bool = False) -> list[Any]:
    """The mark of a case that is not met, or that moves when it is let go again."""
    why = WAITING.get(name) or (MOVES.get(name) if again else None)
    return [pytest.mark.xfail(reason=why, strict=False)] if why else []

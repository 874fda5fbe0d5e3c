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
    "pile of eight boxes": "what rests moves by more than 0.1 mm when it is let go again: see MOVES",
    "six dominoes pushed": "what rests moves by more than 0.1 mm when it is let go again: see MOVES",
    "stack of ten cubes": "half a millimetre falls between each two: the top lands 1.2 mm aside, and 1 mm is allowed",
}
"""What ends otherwise than declared, and how."""

BULLET = "Bullet, which lets it go again, moves it: its parts and its friction are not quite those of exact rest"

MOVES: dict[str, str] = {
    "cube of 2 mm from 1 m": "it turns by 0.14 degrees: 0.01 mm at a corner",
    **dict.fromkeys(
        (
            "cube against a wall, 4 degrees inside of what friction holds",
            "fourteen balls in a pyramid in a tray",
            "row of six dominoes, the first leaning 14 of 8.9 degrees",
            "ladder 8 degrees inside of what friction holds",
            "house of five cards at 62 degrees",
            "see-saw balanced 1 mm inside of its left edge",
            "ring hung on a finger",
            "cube on a wedge of 25 degrees",
            "cube on a wedge of 25 degrees, turned by 30 degrees",
            "arch of seven, thick",
            "ball in a bowl from a file",
        ),
        BULLET,
    ),
}
"""What moves by more than 0.1 mm or 0.1 degrees in the second after it is let go again."""


def marks_of(name: str, let_go: bool = False) -> list[Any]:
    """The mark of a case that is not met, or that moves when it is `let_go` again."""
    why = WAITING.get(name) or (MOVES.get(name) if let_go else None)
    return [pytest.mark.xfail(reason=why, strict=False)] if why else []

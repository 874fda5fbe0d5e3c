"""Hard cases that the program does not meet yet, with what was seen; each is in the table as any other, and must go from here."""

from typing import Any

import pytest

WAITING: dict[str, str] = {
    "pile of a hundred boxes": "no result in 40 s",
    "stack of twenty-five cubes": "no result in 90 s: it sways at 5 to 60 mm/s for all of max_settle_s in the first pace, and "
    "then falls once more, in steps four times as short",
}
"""What ends otherwise than declared, and how."""

BULLET = "Bullet, which lets it go again, moves it: its parts and its friction are not quite those of exact rest"

MOVES: dict[str, str] = {
    "ring hung on a finger": BULLET,
    "ball in a bowl from a file": BULLET,
    "needle of 0.2 by 200 mm tumbled": "its sides are 13 micrometres wide, and Bullet keeps a hull's corners on a grid of 20",
}
"""What moves by more than 0.1 mm or 0.1 degrees in the second after it is let go again."""


def marks_of(name: str, let_go: bool = False) -> list[Any]:
    """The mark of a case that is not met, or that moves when it is `let_go` again."""
    why = WAITING.get(name) or (MOVES.get(name) if let_go else None)
    return [pytest.mark.xfail(reason=why, strict=False)] if why else []

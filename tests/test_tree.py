"""The tree: no room and no file is larger than a person can hold."""

from collections import Counter
from pathlib import Path

from tests.conftest import LONGEST_FIRST, NEEDS

ROOT = Path(__file__).resolve().parents[1]
MOST_LINES = 500
MOST_FILES = 15
"""Of a room: a folder with Python files, its empty `__init__.py` not counted."""


def test_no_file_and_no_room_is_too_large():
    files = [path for top in ("schemas", "workers", "services", "deploy") for path in (ROOT / top).rglob("*.py")]
    assert len(files) > 200
    long = {str(path.relative_to(ROOT)) for path in files if len(path.read_text().splitlines()) > MOST_LINES}
    rooms = Counter(str(path.parent.relative_to(ROOT)) for path in files if path.name != "__init__.py")
    assert not long and {room for room, count in rooms.items() if count > MOST_FILES} == set()


def test_the_places_that_the_choice_of_tests_names_are_there():
    places = [place for places in NEEDS.values() for place in places]
    assert [place for place in places if not (ROOT / place).exists()] == []
    assert [name for name in LONGEST_FIRST if not (ROOT / "tests" / name).exists()] == []

"""The tree of tests mirrors the code, and every file can be read in a sitting."""

from pathlib import Path

from tests.conftest import LONGEST_FIRST

ROOT = Path(__file__).resolve().parents[1]
MAX_LINES = 300

TESTED_ELSEWHERE: dict[str, str] = {
    "services/bench/cycles_script.py": "runs in a foreign interpreter that has bpy",
}
"""Modules of workers and services without a test file of their own, and why."""


def python_files(*folders: str) -> list[Path]:
    """Source files below the folders, without empty packages, sorted."""
    files = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return sorted(path for path in files if path.name != "__init__.py")


def test_no_file_is_longer_than_a_person_reads_at_once():
    files = python_files("schemas", "services", "tests", "workers")
    assert len(files) > 400
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in files}
    assert {name: lines for name, lines in lengths.items() if lines > MAX_LINES} == {}


def test_every_module_has_a_mirrored_test_or_a_reason():
    modules = {str(path.relative_to(ROOT)): path for path in python_files("services", "workers")}
    without = {
        name
        for name, path in modules.items()
        if not (ROOT / "tests" / Path(name).with_name(f"test_{path.name}")).is_file()
    }
    assert without == set(TESTED_ELSEWHERE)
    assert all(TESTED_ELSEWHERE.values())


def test_every_file_that_is_to_run_first_is_there():
    assert [name for name in LONGEST_FIRST if not (ROOT / "tests" / name).is_file()] == []

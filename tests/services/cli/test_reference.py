"""The page of commands is made from the table of commands."""

from pathlib import Path

from services.cli.reference import EXIT_CODES, page
from services.cli.rows import COMMANDS

ROOT = Path(__file__).resolve().parents[3]


def test_the_page_is_the_one_that_the_table_makes():
    """Else: python -m services.cli.reference > docs/commands.md."""
    assert (ROOT / "docs" / "commands.md").read_text() == page()


def test_every_command_and_exit_code_is_on_it():
    lines = page().splitlines()
    for name in COMMANDS:
        assert f"## {name}" in lines
    assert [code for code, _ in EXIT_CODES] == [0, 1, 2]
    assert "| 2 | " in page()

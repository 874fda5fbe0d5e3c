"""docs/columns.md and `verso columns` are what the schemas say."""

import json
from pathlib import Path

import pytest

from schemas.dataset.tables import SCHEMAS, TABLES
from services.cli.main import main
from services.read.columns_page import describe_columns, list_columns, write_page

ROOT = Path(__file__).resolve().parents[3]


def test_the_page_is_up_to_date():
    told = "run `python -m services.read.columns_page > docs/columns.md`"
    assert (ROOT / "docs/columns.md").read_text() == write_page(), told


@pytest.mark.parametrize("table", TABLES)
def test_every_column_stands_on_the_page_and_in_the_terminal(table):
    section = write_page().partition(f"\n## {table}\n")[2].partition("\n## ")[0]
    for name in SCHEMAS[table].names:
        assert f"- `{name}` (" in section or f"`{name}`" in section.partition("- as in ")[2]
        assert any(line.startswith(f"  {name}  (") for line in describe_columns(table))
        assert any(one["path"] == name for one in list_columns(table))
    assert max(map(len, describe_columns(table))) <= 110


def test_the_command_prints_one_table_or_all(capsys):
    assert main(["columns", "failures"]) == 0
    assert capsys.readouterr().out.splitlines()[:2] == [
        "failures: One row for each scene that could not be made, and why.",
        "  key: scene_id",
    ]
    assert main(["columns"]) == 0
    assert all(f"\n{table}: " in "\n" + capsys.readouterr().out for table in list(TABLES)[:1])
    assert main(["columns", "view"]) == 2
    assert "there is no table 'view'; did you mean 'views'? Tables are scenes, views" in capsys.readouterr().err
    assert main(["columns", "failures", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["columns"][0] == {
        "table": "failures",
        "path": "scene_id",
        "type": "int64",
        "nullable": False,
        "captures_only": False,
        "meaning": "The scene, or the capture; ids count from the job's first_scene.",
        "unit": "id",
        "frame": "",
    }

"""What the commands print of a dataset, for people and, in the last line, for programs."""

import json

import pytest

from services.cli.main import main
from tests.datasets import make_dataset
from workers.store.local import LocalStore


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> LocalStore:
    return make_dataset(tmp_path_factory.mktemp("made"))[0]


def answer(capsys, *arguments: str) -> tuple[int, list[str], dict]:
    """Exit code, the lines for people, and the last line parsed."""
    code = main([*arguments, "--json"])
    *lines, last = capsys.readouterr().out.splitlines()
    return code, lines, json.loads(last)


def test_status_of_a_finished_dataset(made, capsys):
    code, lines, told = answer(capsys, "status", made.name)
    assert (code, told["ok"], told["made"], told["missing"]) == (0, True, 2, 0)
    assert lines[0] == f"{made.name}: 2 of 2 scenes done, 0 missing"
    assert lines[-1] == f"  digest: {told['digest']}"


def test_verify_with_the_second_derivation(made, capsys):
    code, lines, told = answer(capsys, "verify", made.name, "--independent", "1")
    assert (code, told["ok"], told["scenes"], told["pairs"]) == (0, True, 2, 2)
    assert (told["independent"]["scenes"], told["independent"]["faults"]) == (1, [])
    assert "2 scenes, labels of 2 pairs derived again: nothing off" in lines[0]
    assert lines[1].startswith("labels of 1 pairs of 1 scenes derived from the article's definitions, and ")
    assert "their rest from contact forces: nothing off" in lines[1]


def test_verify_exits_1_where_a_file_is_gone(capsys, tmp_path):
    store, _ = make_dataset(tmp_path, scenes=1)
    next(tmp_path.glob("*/depth0*.png")).unlink()
    code, lines, told = answer(capsys, "verify", store.name)
    assert (code, told["ok"]) == (1, False)
    assert any("is committed and missing: `verso replay" in line for line in lines)


def test_query_replay_and_scene(made, capsys, tmp_path):
    assert main(["query", made.name, "select scene_id from scenes order by 1", "--format", "csv"]) == 0
    assert capsys.readouterr().out.split() == ["scene_id", "0", "1"]
    assert answer(capsys, "replay", made.name, "1")[2]["differences"] == []
    code, lines, told = answer(capsys, "scene", made.name, "0", "--glb", str(tmp_path / "a.glb"))
    assert (code, told["bytes"]) == (0, (tmp_path / "a.glb").stat().st_size)
    assert lines[0].endswith("MB, world frame, z up, metres")

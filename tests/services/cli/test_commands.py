"""What the commands print of a dataset, for people and, in the last line, for programs."""

import argparse
import json

import pytest

from services.cli import doctor
from services.cli.commands import default_page
from services.cli.doctor import Finding
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


def test_query_and_replay(made, capsys):
    assert main(["query", made.name, "select scene_id from scenes order by 1", "--format", "csv"]) == 0
    assert capsys.readouterr().out.split() == ["scene_id", "0", "1"]
    assert answer(capsys, "replay", made.name, "1")[2]["differences"] == []


def test_a_report_says_what_it_wrote_and_what_it_shows(tmp_path, capsys):
    store, _ = make_dataset(tmp_path / "small", scenes=2, categories=["box"])
    assert main(["report", str(store.root), "--scenes", "1", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    page = tmp_path / "small-report.html"
    assert answer["file"] == str(page) and answer["bytes"] == page.stat().st_size
    assert (answer["scenes"], len(answer["shown"])) == (2, 1)


def test_the_page_lies_beside_its_dataset_and_never_in_it(tmp_path):
    assert default_page(f"{tmp_path}/small/") == tmp_path / "small-report.html"
    assert str(default_page("s3://bucket/sets/small")) == "small-report.html"


@pytest.mark.parametrize(
    ("words", "told"), [(["extra", "audit"], "pip install 'verso-data[audit]'"), (["lock"], "type ./verso lock there")]
)
def test_the_launcher_is_named(words, told, capsys):
    assert main(words) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(("suffices", "code"), [(True, 0), (False, 1)])
def test_a_missing_part_is_told_with_its_remedy_and_exits_1(monkeypatch, capsys, suffices, code):
    for name in ("_python", "_cores", "_memory", "_disk", "_shared_memory", "_ray", "_stack"):
        monkeypatch.setattr(doctor, name, lambda name=name: Finding(name, True, "there"))
    monkeypatch.setattr(doctor, "_renderer", lambda: Finding("GL", suffices, "found", "install it"))
    assert doctor.main(argparse.Namespace(json=True)) == code
    lines = capsys.readouterr().out.splitlines()
    assert any("install it" in line for line in lines[:-1]) is not suffices
    answer = json.loads(lines[-1])
    assert answer["ok"] is suffices and len(answer["findings"]) == 8

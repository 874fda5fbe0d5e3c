"""`verso capture import` writes a capture, tells what is missing, and refuses what cannot be used."""

import json

import pytest

from schemas.errors import CaptureError, InputError, OutputError
from services.cli.main import main
from tests.workers.capture.recording.made_up_recording import recording
from workers.capture.folder import open_folder


def run(*words: object) -> int:
    return main(["capture", "import", *map(str, words)])


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "Mug on table.mkv"
    path.write_bytes(recording(3))
    return path


def test_a_capture_is_written_and_told(saved, tmp_path, capsys):
    out = tmp_path / "my mug"
    assert run(saved, "--out", out, "--frames", 2, "--category", "mug", "--json") == 0
    told = capsys.readouterr().out
    assert "default board (7 x 5, DICT_4X4_50)" in told
    answer = json.loads(told.splitlines()[-1])
    assert (answer["frames"], len(answer["views"]), answer["notes"], answer["default_board"]) == (3, 2, [], True)
    folder = open_folder(out)
    assert (folder.about.name, folder.about.category, folder.numbers) == ("my_mug", "mug", (0, 1))


def test_the_board_given_is_the_capture_s(saved, tmp_path, capsys):
    board = tmp_path / "board.json"
    board.write_text('{"measured_ruler_m": 0.1987}')
    assert run(saved, "--out", tmp_path / "c", "--board", board, "--name", "mug-1") == 0
    folder = open_folder(tmp_path / "c")
    assert folder.board.measured_ruler_m == 0.1987 and folder.about.name == "mug-1"
    assert "default board" not in capsys.readouterr().out


def test_a_cut_recording_is_used_as_far_as_it_goes_and_that_is_told(saved, tmp_path, capsys):
    data = recording(3)
    saved.write_bytes(data[: int(len(data) * 0.7)])
    assert run(saved, "--out", tmp_path / "c", "--json") == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(answer["views"]) == 2
    assert answer["losses"]["cut"] == 1 and "about 1 frames are lost" in answer["notes"][0]


def test_what_cannot_be_done_is_refused_and_leaves_no_capture(saved, tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    short = tmp_path / "short.mkv"
    short.write_bytes(recording(3)[:500])
    for words, code, told in [
        ((tmp_path / "none.mkv", "--out", tmp_path / "x"), InputError.exit_code, "no such file"),
        ((saved, "--out", tmp_path / "full"), OutputError.exit_code, "is not empty"),
        ((saved, "--out", saved), OutputError.exit_code, "cannot be made"),
        ((saved, "--out", tmp_path / "x", "--category", "a mug"), InputError.exit_code, "--category 'a mug'"),
        ((short, "--out", tmp_path / "x"), CaptureError.exit_code, "copy it again"),
    ]:
        assert run(*words) == code
        assert told in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["notes.txt"]
    assert not (tmp_path / "x").exists() or not list((tmp_path / "x").iterdir())

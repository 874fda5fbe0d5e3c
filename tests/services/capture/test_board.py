"""`verso capture board` writes what it was asked for, or says why not."""

import argparse
import json
from pathlib import Path
from typing import Any

import pytest

from schemas.errors import CaptureError, InputError, OutputError
from services import capture as board


def options(path: Path, **changes: Any) -> argparse.Namespace:
    return argparse.Namespace(**{"file": path, "board": None, "tiles": None, "dpi": 100.0, "json": False} | changes)


@pytest.mark.parametrize(
    ("name", "tiles", "start"), [("b.pdf", None, b"%PDF"), ("b.pdf", "a4", b"%PDF"), ("b.PNG", None, b"\x89PNG")]
)
def test_the_file_is_written(tmp_path, capsys, name, tiles, start):
    assert board(options(tmp_path / name, tiles=tiles, json=True)) == 0
    data = (tmp_path / name).read_bytes()
    assert data.startswith(start)
    assert data.count(b"/MediaBox") == (8 if tiles else data.startswith(b"%PDF"))
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["board"]["columns"] == 7


def test_a_board_of_ones_own_is_printed(tmp_path, capsys):
    (tmp_path / "board.json").write_text('{"columns": 3, "rows": 3, "width_m": 0.3, "height_m": 0.28}')
    assert board(options(tmp_path / "b.pdf", board=tmp_path / "board.json")) == 0
    assert "3 x 3 markers" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "tiles"), [("b.jpg", None), ("b", None), ("b.png", "a4")])
def test_another_kind_of_file_is_refused(tmp_path, name, tiles):
    with pytest.raises(InputError, match="ends in"):
        board(options(tmp_path / name, tiles=tiles))
    assert not (tmp_path / name).exists()


def test_a_board_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "board.json").write_text('{"columns": 30}')
    with pytest.raises(CaptureError, match=r"board\.json"):
        board(options(tmp_path / "b.pdf", board=tmp_path / "board.json"))


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        board(options(tmp_path / "none" / "b.pdf"))

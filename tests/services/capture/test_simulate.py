"""`verso capture simulate` writes a capture that can be read, and refuses what cannot be."""

import json

import pytest

from schemas.errors import InputError, OutputError
from services.cli.main import main
from workers.capture.folder import open_folder, read_truth

SMALL = ["--set", "captures.simulate.image_scale=0.1"]


def run(*words):
    return main(["capture", "simulate", *map(str, words)])


def test_a_capture_is_written_and_told(tmp_path, capsys):
    out = tmp_path / "can"
    noisy = ["--set", "captures.simulate.depth_noise={}"]
    assert run("--out", out, "--views", 3, "--category", "can", "--seed", 5, *SMALL, *noisy, "--json") == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["ok"]
    assert (told["views"], told["category"], told["effects"]) == (3, "can", ["depth_noise"])
    folder = open_folder(out)
    assert folder.numbers == (0, 1, 2)
    assert folder.about.category == "can"
    assert len(read_truth(out).T_board_cam) == 3


def test_the_seed_decides_what_is_seen(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert run("--out", tmp_path / name, "--views", 1, "--seed", seed, *SMALL) == 0
    a, b, c = ((tmp_path / name / "rgb_00000.png").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_a_folder_that_has_files_is_left_alone(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert run("--out", tmp_path, "--views", 1, *SMALL) == OutputError.exit_code
    assert "a new or an empty folder" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--category", "cat"], "cat"),
        (["--set", "captures.simulate.print_scale=3"], "print_scale"),
        (["--set", "captures.simulate.fog=1"], "fog"),
    ],
)
def test_what_cannot_be_simulated_is_wrong_input(tmp_path, capsys, words, told):
    assert run("--out", tmp_path / "x", *SMALL, *words) == InputError.exit_code
    assert told in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_more_views_than_a_dataset_keeps_by_default_can_be_made(tmp_path):
    tiny = ["--set", "captures.simulate.image_scale=0.02"]
    assert run("--out", tmp_path / "x", "--views", 65, *tiny) == 0
    assert len(open_folder(tmp_path / "x").numbers) == 65

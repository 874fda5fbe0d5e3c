import json

import pytest

from services.cli.main import main


def test_the_command_says_what_is_there_and_what_was_left_out(files, pile, tmp_path, capsys):
    assert (
        main(["export", files.name, str(tmp_path / "new"), "--format", "mirror-recon", "--scenes", "0-1", "--json"])
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{tmp_path / 'new'}: mirror-recon, 4 pairs of 2 scenes (4 now, in ")
    answer = json.loads(lines[-1])
    assert (answer["ok"], answer["pairs"], answer["pairs_now"]) == (True, 4, 4)
    assert answer["choice"] == {"first_scene": 0, "last_scene": 1}
    assert main(["export", pile.name, str(tmp_path / "pile"), "--format", "mirror-recon"]) == 1
    told = capsys.readouterr()
    assert "left out: 1 pairs, several objects" in told.out and "left_out.csv" in told.out
    assert "holds no pair: every pair was left out" in told.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--format", "nosuch"], "invalid choice"),
        ([], "--format"),
        (["--format", "mirror-recon", "--scenes", "5-3"], "ends before it begins"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_exit_code_2(words, told, tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["export", "nosuch", str(tmp_path / "new"), *words])
    assert caught.value.code == 2
    assert told in capsys.readouterr().err


def test_a_folder_that_is_no_dataset_is_refused_in_one_line(tmp_path, capsys):
    assert main(["export", str(tmp_path), str(tmp_path / "new"), "--format", "mirror-recon"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_a_bucket_is_no_folder_to_export_into(files, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", files.name, "s3://bucket/new", "--format", "mirror-recon"]) == 2
    assert "on this machine" in capsys.readouterr().err and not list(tmp_path.iterdir())

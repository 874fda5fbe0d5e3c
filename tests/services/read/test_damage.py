"""Commands that read end in one line, whatever is damaged."""

import pytest

from services.cli.main import main
from services.read.verdict import explain_damage
from tests.damage import choose_places, damaged
from workers.store.local import LocalStore

SQL = "select * from views join scenes using (scene_id), objects, assets, failures, timings"
COMMANDS = (
    ("verify", "{out}"),
    ("status", "{out}"),
    ("query", "{out}", SQL),
)


def test_errors_of_files_become_one_line(tmp_path):
    store = LocalStore(tmp_path)
    for raised in (IsADirectoryError(21, "Is a directory", "a"), ValueError("two\nlines"), OSError(5, "broken")):
        with pytest.raises(Exception, match="`verso verify") as told, explain_damage(store):
            raise raised
        assert "\n" not in str(told.value)


def outcomes(copy, capsys, places, commands) -> list[str]:
    """What commands said of damage that is no line of words: tracebacks raise by themselves."""
    wrong = []
    for path, how, place in places:
        with damaged(copy, path, how, place):
            for command in commands:
                code = main([word.format(out=copy) for word in command])
                told = capsys.readouterr().err
                # `status` and `replay` may find a difference, and tell it on standard output.
                lines = {1} if code and command[0] not in ("verify", "status", "replay") else {0, 1}
                if code not in (0, 1, 2) or told.count("\n") not in lines:
                    wrong.append(f"{path}, {how} {place}: {command[0]} {code}: {told}")
    return wrong


def test_no_command_ends_in_a_traceback(copy, capsys):
    places = list(choose_places(copy, 300, 9))
    assert outcomes(copy, capsys, places[::12], COMMANDS[1:3]) == []
    assert outcomes(copy, capsys, places[::80], COMMANDS) == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_command_ends_in_a_traceback_in_any_of_300_places(copy, capsys):
    assert outcomes(copy, capsys, choose_places(copy, 300, 10), (*COMMANDS, ("replay", "{out}", "1"))) == []


def test_a_folder_in_the_place_of_each_kind_of_file_is_told(copy, capsys):
    for name in (
        "job.yaml",
        "_SUCCESS",
        "manifest/_fingerprint.json",
        "manifest/_commits/0000000001.json",
        "camPoses.csv",
    ):
        file = copy / name
        data = file.read_bytes()
        file.unlink()
        file.mkdir()
        for command in COMMANDS[:3]:
            code = main([word.format(out=copy) for word in command])
            assert code in (0, 1, 2)
            assert command[0] != "verify" or (code == 1 and f"{name}: " in capsys.readouterr().out)
        file.rmdir()
        file.write_bytes(data)

import importlib

import pytest

from services.cli.parser import build_parser
from services.cli.rows import COMMANDS


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("test", "capture")])
def test_a_commands_example_is_accepted_and_its_handler_exists(name):
    words = COMMANDS[name].example.replace('"', "").split()
    if name == "query":
        words = [words[0], " ".join(words[1:])]
    options = build_parser().parse_args([name, *words])
    module, _, function = options.handler.partition(":")
    assert callable(getattr(importlib.import_module(module), function))


@pytest.mark.parametrize(
    "words", [["run", "j", "--workers", "0"], ["replay", "o", "x"], ["verify", "o", "--audit", "x"]]
)
def test_a_number_that_cannot_be_is_refused(words, capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(words)
    assert caught.value.code == 2
    assert "whole number" in capsys.readouterr().err


def test_a_command_that_has_commands_asks_for_one(capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(["capture"])
    assert caught.value.code == 2
    assert "COMMAND" in capsys.readouterr().err

"""docs/queue.md: its commands are accepted, and its states are those of the code."""

import re
import shlex
from pathlib import Path
from typing import get_args

import pytest

from services.cli.main import build_parser
from services.cli.rows import QUEUE_COMMANDS
from services.queue.queue import RESTARTS, JobState
from services.queue.supervise import PAUSES_S

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "queue.md").read_text()
LINES = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]
COMMANDS = [shlex.split(line)[1:] for line in LINES if line.startswith("./verso ")]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_command_of_the_page_is_accepted(words):
    assert build_parser().parse_args(words).handler.endswith(f":{words[0]}")


def test_the_page_shows_each_command_that_a_user_types():
    assert {words[0] for words in COMMANDS} == QUEUE_COMMANDS.keys() - {"drive"}


def test_the_page_lists_each_state():
    table = PAGE.partition("## States")[2].partition("##")[0]
    assert re.findall(r"^\| (\w+) \|", table, re.MULTILINE)[1:] == list(get_args(JobState))


def test_the_page_tells_the_pauses():
    assert f"rests for {', then '.join(f'{pause:g} s' for pause in PAUSES_S)}," in PAGE
    assert RESTARTS == 3 and "three times at most" in PAGE

"""The table of commands: what may be typed, what is refused in a short line, and what is written from it."""

import argparse
import importlib
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.cli.arguments import Command, read_span
from services.cli.main import build_parser
from services.cli.reference import commands_page, script_for
from services.cli.rows import COMMANDS

ROOT = Path(__file__).resolve().parents[3]


def commands() -> Iterator[tuple[list[str], Command]]:
    """Every command that has a handler, with its words."""
    for name, command in COMMANDS.items():
        yield from (([name, below], inner) for below, inner in command.commands.items())
        yield from () if command.commands else (([name], command),)


def parse(*words: str) -> argparse.Namespace:
    return build_parser().parse_args(words)


def refusal(capsys, words: list[str]) -> str:
    """The last line for words that are refused."""
    with pytest.raises(SystemExit) as caught:
        parse(*words)
    assert caught.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_every_example_is_accepted_its_handler_exists_and_its_help_shows_it(capsys):
    for words, command in commands():
        options = parse(*words, *shlex.split(command.example))
        module, _, function = f"services.{options.handler}".partition(":")
        assert callable(getattr(importlib.import_module(module), function)), words
        with pytest.raises(SystemExit) as caught:
            parse(*words, "--help")
        shown = " ".join(capsys.readouterr().out.split())
        assert caught.value.code == 0 and "--json" in shown
        assert f"example: verso {' '.join(words)} {command.example}".rstrip() in shown


def test_the_page_is_the_one_that_the_table_makes():
    """Else: python -m services.cli.reference commands > docs/commands.md."""
    assert (ROOT / "docs" / "commands.md").read_text() == commands_page()
    for words, _ in commands():
        assert f"# {' '.join(words)}\n" in commands_page()


HOSTILE = (
    (["run", "j", "--scenes", "9" * 100_000], "'999"),
    (["run", "j", "--scenes", "²"], "whole number"),
    (["run", "j", "--workers", "0"], "whole number"),
    (["replay", "o", "x"], "whole number"),
    (["verify", "o", "--audit", "x"], "whole number"),
    (["report", "o", "--scenes", "0"], "'0' is not a whole number from 1 up"),
    (["run", "j", "--out", "a\0b"], "'a\\x00b'"),
    (["run", "j", "--out", ""], "''"),
    (["run", "j", "--out", "\x1b[31m"], "\\x1b[31m"),
    (["run", "x" * 100_000], "'xxx"),
    (["status", "a\0b"], "'a\\x00b'"),
    (["run", "j", "--address", "x" * 70 + ":6379"], "HOST:PORT"),
    (["run", "j", "--address", "localhost:99999"], "HOST:PORT"),
    (["run", "j", "--address", "a\0b:6379"], "HOST:PORT"),
    (
        ["run", "j", "--address", "ray://h:10001"],
        "HOST:PORT (port 6379 by default) on a machine of the cluster, or `ray su",
    ),
    (["run", "j", "--metrics", "9464"], "HOST:PORT"),
    (["\x1b[31m" * 10_000], "\\x1b[31m"),
    (["run"], "JOB.yaml"),
    (["fly"], "invalid choice: 'fly'; choose from init, run"),
    (["expert", "d"], "'expert'; did you mean 'export'? choose from"),
    (["capture", "procss"], "'procss'; did you mean 'process'? choose from board"),
    (["run", "j", "--scnes", "3"], "verso run: error: unrecognized arguments: --scnes 3; did you mean '--scenes'?"),
    (["export", "d", "n", "--format", "occ-net"], "did you mean 'occnet'? choose from mirror-recon"),
    (["export", "d", "new"], "--format"),
    (["export", "d", "new", "--format", "nosuch"], "invalid choice"),
    (["capture"], "COMMAND"),
    (["capture", "board", "b.pdf", "--tiles", "a3"], "a3"),
    (["capture", "simulate", "--views", "4"], "--out"),
    (["capture", "simulate", "--out", "d", "--views", "0"], "whole number"),
    (["capture", "process", "d", "--estimate", "best"], "best"),
    (["capture", "synthesize", "d"], "--pose --mirror"),
    (["capture", "synthesize", "d", "--mirror", "--pose", "p.txt"], "not allowed"),
    (["logs", "../../etc"], "error: argument"),
    (["cancel", "j0a1b2c3"], "error: argument"),
    (["logs", "$(touch x)"], "error: argument"),
    (["submit", "j.yaml", "--priority", "high"], "error: argument"),
    (["submit", "j.yaml", "--priority", "1001"], "error: argument"),
    (["supervise", "--at-once", "0"], "error: argument"),
    (["supervise", "--address", "127.0.0.1:8265"], "error: argument"),
    (["supervise", "--address", "http://user:secret@host:8265"], "error: argument"),
    (["drive", "j0a1b2c3d", "0"], "error: argument"),
)


def test_what_cannot_be_meant_is_refused_in_a_short_line(capsys):
    for words, why in HOSTILE:
        line = refusal(capsys, words)
        assert why in line, words
        assert line.isprintable() and len(line) < 500, line
    for text in ("", "-", "3-", "5-3", "a-b", "1-2-3"):
        with pytest.raises(argparse.ArgumentTypeError):
            read_span(text)


def test_what_can_be_meant_is_taken():
    assert (read_span("0-63"), read_span("7")) == ((0, 63), (7, 7))
    for address in ("auto", "127.0.0.1:6379", "head.cluster.local:6379", "[::1]:6379", "a_b-c:1"):
        assert parse("run", "j", "--address", address).address == address
    assert parse("submit", "j.yaml", "--priority", "-5").priority == -5
    one = parse("capture", "synthesize", "d", "--pose", "p.txt")
    assert (str(one.pose), one.mirror, one.out) == ("p.txt", False, None)
    assert parse("capture", "simulate", "--out", "d", "--set", "a=1", "--set", "b=2").changes == ["a=1", "b=2"]
    starts = [parse("bench", *words) for words in ([], ["--workers", "2"])]
    assert [options.starts_ray(options) for options in starts] == [False, True]


ASK = """
source "$1"
COMP_WORDS=({words}) COMP_CWORD={at} COMP_LINE="{words}" COMP_POINT=99
_shtab_verso "verso" "{last}" ""
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def test_bash_completes_commands_and_options(tmp_path):
    assert shutil.which("bash")
    script = tmp_path / "verso.bash"
    script.write_text(script_for("bash"))
    for typed, offered in (
        ("verso trad", "tradeoff"),
        ("verso run --dry", "--dry-run"),
        ("verso capture bo", "board"),
        ("verso query --fo", "--format"),
    ):
        words = typed.split()
        ask = ASK.format(words=typed, at=len(words) - 1, last=words[-1])
        done = subprocess.run(["bash", "-c", ask, "bash", str(script)], capture_output=True, text=True, check=True)
        assert offered in done.stdout.split()
    assert "#compdef verso" in script_for("zsh")
    assert "complete verso" in script_for("tcsh")

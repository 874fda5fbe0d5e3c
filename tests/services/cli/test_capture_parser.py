import importlib
import shlex
import subprocess
import sys

import pytest

from services.cli.parser import build_parser
from services.cli.rows import CAPTURE_COMMANDS


@pytest.mark.parametrize("name", CAPTURE_COMMANDS)
def test_an_example_of_a_capture_command_is_accepted_and_names_its_handler(name):
    options = build_parser().parse_args(["capture", name, *shlex.split(CAPTURE_COMMANDS[name].example)])
    module, _, function = options.handler.partition(":")
    assert module == "services.capture"
    assert function.startswith(name)
    assert callable(getattr(importlib.import_module(module), function))
    assert not options.starts_ray(options)


@pytest.mark.parametrize("name", CAPTURE_COMMANDS)
def test_help_of_a_capture_command_has_its_example(name, capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(["capture", name, "--help"])
    assert caught.value.code == 0
    told = " ".join(capsys.readouterr().out.split())
    assert f"example: verso capture {name} {CAPTURE_COMMANDS[name].example}" in told
    assert "--json" in told


@pytest.mark.parametrize(
    "words",
    [
        ["board"],
        ["board", "b.pdf", "--tiles", "a3"],
        ["simulate", "--views", "4"],
        ["simulate", "--out", "d", "--views", "0"],
        ["import", "r.mkv"],
        ["process", "d", "--estimate", "best"],
        ["synthesize", "d"],
        ["synthesize", "d", "--mirror", "--pose", "p.txt"],
        ["evaluate"],
    ],
)
def test_a_capture_command_line_that_cannot_be_is_refused(words, capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(["capture", *words])
    assert caught.value.code == 2
    assert "usage: verso capture" in capsys.readouterr().err


def test_options_of_a_capture_command_have_the_names_that_its_handler_reads():
    read = build_parser().parse_args
    simulate = read(["capture", "simulate", "--out", "d", "--set", "a=1", "--set", "b=2"])
    assert (simulate.views, simulate.seed, simulate.category, simulate.changes) == (None, 0, "mug", ["a=1", "b=2"])
    one, mirror = (read(["capture", "synthesize", "d", *words]) for words in (["--pose", "p.txt"], ["--mirror"]))
    assert (str(one.pose), one.mirror, one.out) == ("p.txt", False, None)
    assert (mirror.pose, mirror.mirror) == (None, True)


def test_help_of_captures_loads_nothing_heavy():
    code = (
        "import sys\nfrom services.cli.parser import build_parser\n"
        "try: build_parser().parse_args(['capture', '--help'])\nexcept SystemExit: pass\n"
        "assert not {'numpy', 'cv2', 'scipy', 'ray', 'pydantic', 'av'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, timeout=60)

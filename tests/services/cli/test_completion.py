"""What completes commands and options in a shell, tried in bash itself."""

import shutil
import subprocess

import pytest

from services.cli.reference import script_for

ASK = """
source "$1"
COMP_WORDS=({words}) COMP_CWORD={at} COMP_LINE="{words}" COMP_POINT=99
_shtab_verso "verso" "{last}" ""
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    file = tmp_path_factory.mktemp("completion") / "verso.bash"
    file.write_text(script_for("bash"))
    return file


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("verso trad", "tradeoff"),
        ("verso run --dry", "--dry-run"),
        ("verso capture bo", "board"),
        ("verso query --fo", "--format"),
    ],
)
def test_bash_completes_commands_and_options(script, typed, offered):
    words = typed.split()
    ask = ASK.format(words=typed, at=len(words) - 1, last=words[-1])
    done = subprocess.run(["bash", "-c", ask, "bash", str(script)], capture_output=True, text=True, check=True)
    assert offered in done.stdout.split()


def test_zsh_and_tcsh_have_theirs():
    assert "#compdef verso" in script_for("zsh")
    assert "complete verso" in script_for("tcsh")

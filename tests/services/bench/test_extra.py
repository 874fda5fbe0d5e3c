"""Without the extra `study` both its commands say so at once, with the remedy; all others work."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from schemas.errors import MachineError
from services.bench.command import PACKAGES, require_extra
from services.cli.main import main

ROOT = Path(__file__).resolve().parents[3]
JOB = str(ROOT / "deploy" / "jobs" / "tabletop.yaml")


def test_where_all_is_installed_nothing_is_said():
    require_extra("bench")


@pytest.mark.parametrize("package", PACKAGES)
def test_a_missing_package_is_named_with_both_remedies(monkeypatch, package):
    monkeypatch.setattr("services.bench.command.find_spec", lambda name: None if name == package else object())
    with pytest.raises(MachineError, match=rf"needs {PACKAGES[package]}: .*extra study.*requirements-study\.lock"):
        require_extra("tradeoff")


@pytest.mark.parametrize("words", [["bench"], ["tradeoff", JOB, "--out", "OUT"]])
def test_the_command_ends_with_the_one_message_before_anything_is_made(monkeypatch, tmp_path, capsys, words):
    monkeypatch.setattr("services.bench.command.find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--json"]) == 1
    told = capsys.readouterr()
    assert told.err.count("\n") == 1 and "./verso extra study" in told.err
    assert json.loads(told.out)["kind"] == "MachineError"
    assert list(tmp_path.iterdir()) == []


def test_both_commands_load_without_the_extra():
    """So that the message is what a user sees, and no ImportError."""
    hide = f"import sys; sys.modules.update(dict.fromkeys({list(PACKAGES)!r}))"
    code = f"{hide}; import services.bench.command, services.study.command, services.study.study"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")

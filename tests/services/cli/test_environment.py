import json
import os
import subprocess
import sys
from pathlib import Path

from schemas.environment import KEEP, STACK_ENVIRONMENT

ROOT = Path(__file__).resolve().parents[3]

PRINT_ENVIRONMENT = """
import json, os, sys
from services.cli.environment import enter_stack_environment
enter_stack_environment()
print(json.dumps([dict(os.environ), sys.argv, hash("verso"), sys.flags.safe_path]))
"""


def start(environ: dict[str, str], tmp_path: Path, *args: str) -> list:
    script = tmp_path / "script.py"
    script.write_text(PRINT_ENVIRONMENT)
    done = subprocess.run(
        [sys.executable, "-P", str(script), *args],
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), **environ},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def test_a_bare_process_starts_itself_again_in_the_stacks_environment(tmp_path):
    environ, argv, _, safe_path = start({"OMP_NUM_THREADS": "64", "OTHER": "kept"}, tmp_path, "a b", "--c=*")
    assert {name: environ[name] for name in STACK_ENVIRONMENT} == dict(STACK_ENVIRONMENT)
    assert environ["OTHER"] == "kept"
    assert argv[1:] == ["a b", "--c=*"]
    assert safe_path


def test_hashes_of_strings_are_the_same_in_every_process(tmp_path):
    hashes = {start({"PYTHONHASHSEED": seed}, tmp_path)[2] for seed in ("random", "1", "2")}
    assert len(hashes) == 1


def test_a_user_may_keep_the_environment(tmp_path):
    environ, *_ = start({KEEP: "1", "OMP_NUM_THREADS": "64"}, tmp_path)
    assert environ["OMP_NUM_THREADS"] == "64"
    assert "PYGLET_HEADLESS" not in environ

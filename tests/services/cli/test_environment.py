import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from schemas.environment import KEEP, STACK_ENVIRONMENT
from services.cli.environment import processor_flags

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


def test_processor_flags_are_those_of_the_first_core(tmp_path):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nflags\t\t: fpu avx2 bmi2\n\nflags\t\t: other\n")
    assert processor_flags(cpuinfo) == {"fpu", "avx2", "bmi2"}
    cpuinfo.write_text("Features\t: asimd\n")
    assert processor_flags(cpuinfo) == frozenset()
    assert processor_flags(tmp_path / "absent") == frozenset()


@pytest.mark.parametrize(
    "door",
    [
        ["-P", "-m", "services.cli.main", "--version"],
        ["-P", "-c", "import services.cli.main as c; c.main()", "--version"],
    ],
)
def test_the_command_line_runs_in_the_stacks_environment_through_either_door(tmp_path, door):
    starts = tmp_path / "starts"
    (tmp_path / "sitecustomize.py").write_text(
        f"import json, os\nwith open({str(starts)!r}, 'a') as f: print(json.dumps(dict(os.environ)), file=f)\n"
    )
    environ = {"PATH": os.environ["PATH"], "PYTHONPATH": f"{tmp_path}:{ROOT}"}
    done = subprocess.run([sys.executable, *door], env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    last = json.loads(starts.read_text().splitlines()[-1])
    assert {name: last.get(name) for name in STACK_ENVIRONMENT} == dict(STACK_ENVIRONMENT)

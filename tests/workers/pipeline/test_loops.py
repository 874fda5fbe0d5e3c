"""The list of loops, and processes that compile it together."""

import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from inspect import signature
from pathlib import Path

import numba.types
import pytest
from numba.core.sigutils import normalize_signature

from deploy.compile_loops import all_loops
from workers.geometry.jit import used_by
from workers.pipeline.loops import LIST

ROOT = Path(__file__).parents[3]
ENTRIES = [line.split(" ", 2) for line in LIST.read_text().splitlines()]
LOOPS = """
import time
from numba.extending import overload
from workers.geometry.jit import compiled

def pause(x):
    return x

@overload(pause)
def _pause(x):
    time.sleep({pause})
    return lambda x: x

"""
NAMES = "abcdefgh"
ELSEWHERE = {
    "workers.geometry.distance": {"_nearest", "_box_distance2", "_search"},
    "workers.geometry.pixels": {"_facing_cosine"},
    "workers.geometry.rational_lens": {"_distort", "_pixel_rays", "_project_points"},
    "workers.geometry.zbuffer": {"_draw", "_draw_triangle", "_lift"},
    "workers.capture.rows": {"_meets_rectangle"},
}
"""Loops that only captures, models of sensors and some sources of assets use."""
COMPILE = """
import sys
from pathlib import Path
from workers.pipeline import loops
loops.LIST = Path("list.txt")
print(loops.compile_together(), flush=True)
import tiny
print(*(tiny.a(2) for _ in "a"), sum(sum(getattr(tiny, name).stats.cache_misses.values()) for name in {names!r}))
"""


@pytest.mark.parametrize(("module", "name", "types"), ENTRIES)
def test_every_entry_is_a_loop_with_so_many_arguments(module, name, types):
    loop = getattr(import_module(module), name)
    arguments, result = normalize_signature(types)
    assert result is None and all(isinstance(one, numba.types.Type) for one in arguments)
    assert len(arguments) == len(signature(loop.py_func).parameters)


def test_no_loop_comes_before_one_that_it_calls():
    """Else two processes would compile the same loop."""
    last = {(module, name): place for place, (module, name, _) in enumerate(ENTRIES)}
    for place, (module, name, _) in enumerate(ENTRIES):
        loop = getattr(import_module(module), name).py_func
        called = {key for key in used_by(loop) if key in last and key != (module, name)}
        assert all(last[key] < place for key in called), name


def test_no_loop_is_missing_but_those_that_few_jobs_use():
    """Else it would be compiled in the middle of a job, for 20 MB that stay."""
    missing: dict[str, set[str]] = {}
    for loop in all_loops():
        module, name = loop.__module__, loop.__name__
        if [module, name] not in [entry[:2] for entry in ENTRIES] and not module.startswith("workers.capture."):
            missing.setdefault(module, set()).add(name)
    assert missing == ELSEWHERE


def folder_of_loops(folder: Path, pause: float) -> dict[str, str]:
    """Eight small loops that take a while to compile, and their list; returns the environment to compile them in."""
    loops = "".join(f"@compiled\ndef {name}(x):\n    return pause(x) + 1\n\n" for name in NAMES)
    (folder / "tiny.py").write_text(LOOPS.format(pause=pause) + loops)
    (folder / "list.txt").write_text("".join(f"tiny {name} (int64,)\n" for name in NAMES))
    return {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kept"), "PYTHONPATH": f"{folder}:{ROOT}"}


def start(folder: Path, env: dict[str, str]) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", COMPILE.format(names=NAMES)], stdout=subprocess.PIPE, text=True, cwd=folder, env=env
    )


def numbers(process: "subprocess.Popen[str]") -> list[int]:
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    return [int(number) for number in out.split()]


def test_processes_that_start_at_once_share_the_loops_and_later_ones_find_them(tmp_path):
    """Each loop is compiled by one of them; who comes later takes none, and reads what it uses."""
    env = folder_of_loops(tmp_path, 0.3)
    shares = [numbers(process)[0] for process in [start(tmp_path, env) for _ in range(2)]]
    assert sum(shares) == len(NAMES) and min(shares) > 0
    assert numbers(start(tmp_path, env)) == [0, 3, 0]


def test_what_a_killed_process_was_compiling_is_compiled_by_the_next(tmp_path):
    env = folder_of_loops(tmp_path, 0.6)
    killed = start(tmp_path, env)
    for _ in range(600):
        states = list((tmp_path / "kept").rglob("loops-*"))
        if states and 0 < len(states[0].read_bytes()) < len(NAMES):
            break
        time.sleep(0.05)
    with killed:
        killed.send_signal(signal.SIGKILL)
    left = len(NAMES) - states[0].read_bytes().count(b"\1")
    assert 0 < left < len(NAMES)
    assert numbers(start(tmp_path, env))[0] == left
    assert numbers(start(tmp_path, env))[0] == 0


def test_a_changed_list_is_compiled_anew_and_the_old_state_goes(tmp_path):
    env = folder_of_loops(tmp_path, 0.0)
    assert numbers(start(tmp_path, env))[0] == len(NAMES)
    (tmp_path / "list.txt").write_text("tiny a (int64,)\ntiny a (float64,)\n")
    assert numbers(start(tmp_path, env))[0] == 2, "one of them only has to be read"
    assert len(list((tmp_path / "kept").rglob("loops-*"))) == 1


def test_where_nothing_can_be_written_nothing_is_compiled_before_it_is_used(tmp_path, monkeypatch):
    from workers.pipeline import loops

    (tmp_path / "file").write_text("")
    for folders in ((), (tmp_path / "file" / "kept", tmp_path)):
        monkeypatch.setattr(loops, "_folders", lambda folders=folders: folders)
        assert loops.compile_together() == 0
    assert [path.name for path in tmp_path.iterdir()] == ["file"]

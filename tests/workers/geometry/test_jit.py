"""Compiled loops: the order in which they add, where they are kept, and processes that compile them together."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from workers import source
from workers.geometry import jit
from workers.geometry.frames import add_up
from workers.source import are_kept, folder_name

ROOT = Path(__file__).resolve().parents[3]
HEAD = """
import time
from numba.extending import overload
from workers.geometry.jit import compile_planned, compiled, compiled_for
def pause(x): return x
@overload(pause)
def _pause(x):
    time.sleep({pause})
    return lambda x: x
def kept(*loops): return sum(sum(loop.stats.cache_hits.values()) for loop in loops)
"""
ONE_LOOP = "@compiled\ndef run(x):\n    return pause(x) + 1\n"
NAMES = "abcd"
TOGETHER = (
    f"import {', '.join(NAMES)}; from a import compile_planned; print(compile_planned()); print(a.run(2), kept(a.run))"
)
SCENES = """
from numba.core.event import install_recorder
from workers.geometry.jit import compile_planned
from workers.shard.run_shard import _fingerprint
compile_planned()
with install_recorder("numba:compile") as recorder:
    _fingerprint("raster")
names = {event.data["dispatcher"].py_func.__module__ for _, event in recorder.buffer}
print(sorted(name for name in names if name.startswith("workers.")))
"""


def project(folder: Path, pause: float = 0.0, **modules: str) -> None:
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(HEAD.format(pause=pause) + text)


def start(folder: Path, program: str, kept: Path | None = None) -> "subprocess.Popen[str]":
    env = {**os.environ, "NUMBA_CACHE_DIR": str(kept or folder / "kept"), "PYTHONPATH": f"{folder}:{ROOT}"}
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, cwd=folder, env=env)


def said(process: "subprocess.Popen[str]") -> list[str]:
    out, _ = process.communicate(timeout=200)
    assert process.returncode == 0
    return out.split()


def test_a_compiled_loop_and_add_up_add_in_the_order_that_is_written():
    @jit.compiled
    def total(values: np.ndarray) -> float:
        result = 0.0
        for value in values:
            result += value
        return result

    values = np.array([1e16, 1.0, -1e16] * 9)  # 1e16 + 1 is 1e16
    assert total(values) == add_up(values.tolist()) == 0.0


@pytest.mark.minute
def test_a_loop_is_compiled_also_where_nothing_can_be_kept_on_disk(tmp_path):
    project(tmp_path, loops=ONE_LOOP)
    (tmp_path / "file").write_text("")
    program = "from loops import *; print(run(2), compile_planned(), compiled(eval('lambda x: x + 1'))(41))"
    for folder in (tmp_path / "file", tmp_path / "kept"):  # in the second, what has no file has no place
        assert said(start(tmp_path, program, folder)) == ["3", "0", "42"]


def test_the_folder_is_another_one_where_anything_changes_that_a_loop_may_be_made_of(tmp_path, monkeypatch):
    texts = {
        "workers/loop.py": "from workers.near import A\n@compiled\ndef f(x): ...\n",
        "workers/near.py": "from schemas.far import A\n",
        "schemas/far.py": "A = 1\n",
        "workers/other.py": "B = 1\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    before = folder_name(tmp_path)
    for name, text in texts.items():
        (tmp_path / name).write_text(f"{text}C = 3\n")
        assert (folder_name(tmp_path) == before) == (name == "workers/other.py")
        (tmp_path / name).write_text(text)
    assert folder_name(tmp_path) == before


def test_whether_loops_are_kept_is_known_without_numba_by_what_is_there_of_every_planned_file(tmp_path, monkeypatch):
    texts = {"a": "\n@compiled_for('i8')\n", "b": "\n@compiled_for('f8')\n", "c": "\n@compiled\n"}
    (tmp_path / "workers").mkdir()
    for name, text in texts.items():
        (tmp_path / "workers" / f"{name}.py").write_text(text)
    monkeypatch.setattr(source, "ROOT", tmp_path)
    monkeypatch.setattr(source, "folder_name", lambda: "loops-0")
    kept = tmp_path / "cache" / "loops-0"
    kept.mkdir(parents=True)
    for module, told in (("workers.a", False), ("workers.b", True)):
        assert not are_kept(str(tmp_path / "cache"))
        (kept / f"{module}-1a2b3c4d.kept").touch()
        assert are_kept(str(tmp_path / "cache")) is told
    ask = "import sys; from workers.source import are_kept; are_kept(None); print('numba' in sys.modules)"
    assert said(start(tmp_path, ask)) == ["False"]


@pytest.mark.minute
def test_processes_that_start_at_once_share_the_planned_loops_and_later_ones_read_them(tmp_path):
    project(tmp_path, 0.3, **{name: ONE_LOOP.replace("compiled", 'compiled_for("i8")') for name in NAMES})
    program = TOGETHER.replace("kept(", "a.kept(")
    shares = [int(said(each)[0]) for each in [start(tmp_path, program) for _ in range(2)]]
    assert sum(shares) == len(NAMES) and min(shares) > 0
    assert said(start(tmp_path, program)) == ["0", "3", "1"]


@pytest.mark.minute
def test_what_a_killed_process_was_compiling_is_compiled_by_the_next(tmp_path):
    project(tmp_path, 0.6, **{name: ONE_LOOP.replace("compiled", 'compiled_for("i8")') for name in NAMES})
    program = TOGETHER.replace("kept(", "a.kept(")
    killed = start(tmp_path, program)
    while not (done := list((tmp_path / "kept").rglob("*.kept"))):
        time.sleep(0.05)
    with killed:
        killed.send_signal(signal.SIGKILL)
    done = list((tmp_path / "kept").rglob("*.kept"))
    assert said(start(tmp_path, program))[0] == str(len(NAMES) - len(done))
    assert said(start(tmp_path, program))[0] == "0"


@pytest.mark.minute
def test_two_processes_that_compile_one_loop_at_once_never_mix_up_its_types(tmp_path):
    project(tmp_path, 0.5, loops=ONE_LOOP)
    program = "from loops import *; print(run({0}), kept(run))"
    both = [start(tmp_path, program.format(value)) for value in ("2", "2.5")]
    assert [said(each) for each in both] == [["3", "0"], ["3.5", "0"]]
    assert said(start(tmp_path, "from loops import *; print(run(2), run(2.5), kept(run))")) == ["3", "3.5", "2"]


@pytest.mark.minute
def test_loops_that_were_compiled_with_an_image_are_read_where_this_process_keeps_its_own_elsewhere(tmp_path):
    project(tmp_path, loops=ONE_LOOP)
    made = "import sys; from pathlib import Path; import workers.geometry.jit as jit; "
    assert said(start(tmp_path, "from loops import *; print(run(2))", tmp_path / "image")) == ["3"]
    (tmp_path / "image").chmod(0o555)
    program = f"{made}jit.MADE_WITH_THE_CODE = Path('image'); jit._config.CACHE_DIR = 'own'; jit._folder = jit._open_folder(); "
    program += "from loops import *; print(run(2), kept(run))"
    assert said(start(tmp_path, program, tmp_path / "unused")) == ["3", "1"]
    assert list((tmp_path / "own").rglob("*.nbc"))


@pytest.mark.slow
def test_a_scene_needs_no_loop_that_was_not_planned(tmp_path):
    """Else each worker compiles it by itself, in the middle of a job."""
    assert said(start(tmp_path, SCENES)) == ["[]"]

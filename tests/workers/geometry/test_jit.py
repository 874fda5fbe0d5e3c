"""Compiled loops: where they are kept, and the order in which they add."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from workers.geometry.jit import _LoopFile, compiled

ROOT = Path(__file__).resolve().parents[3]


def test_a_loop_is_compiled_also_where_nothing_can_be_kept_on_disk():
    program = "from workers.geometry import jit; print(jit.compiled(eval('lambda x: x + 1'))(41))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "42"


def test_a_compiled_loop_adds_in_the_order_that_is_written():
    @compiled
    def total(values: np.ndarray) -> float:
        result = 0.0
        for value in values:
            result += value
        return result

    values = np.array([1e16, 1.0, -1e16] * 9)
    assert total(values) == sum(values.tolist())


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("def step(x):\n    return x + 1", "def step(x):\n    return x + 20"),
        ("np.floor", "np.ceil"),
        ("from far import step", "from farther import step"),
        ("FACTOR = 3.0", "FACTOR = 50.0"),
        ("TABLE = np.arange(3.0)", "TABLE = np.arange(3.0) + 7.0"),
        ("WEIGHTS = (1.0, 2.0)", "WEIGHTS = (1.0, 90.0)"),
    ],
)
def test_what_a_kept_loop_uses_of_another_file_may_change(before, after, tmp_path):
    """The file of the loop itself stays as it is; it calls a loop that is defined below it, and that uses the tables."""
    head = "import numpy as np\nfrom workers.geometry.jit import compiled\n"
    imports = "from near import FACTOR, step\nfrom tables import TABLE, WEIGHTS\n"
    run = "@compiled\ndef run(x):\n    return FACTOR * step(x) + last(x)\n"
    last = "@compiled\ndef last(x):\n    return TABLE[1] + sum([n * WEIGHTS[1] for n in range(3)])\n"
    step = before if "far" in before else "@compiled\ndef step(x):\n    return x + 1 + np.floor(0.5 * x + 0.1)"
    files = {
        "far": f"{head}@compiled\ndef step(x):\n    return x - 4\n",
        "farther": f"{head}@compiled\ndef step(x):\n    return x - 60\n",
        "near": f"{head}FACTOR = 3.0\n{step}\n",
        "tables": f"{head}TABLE = np.arange(3.0)\nWEIGHTS = (1.0, 2.0)\n",
        "loops": head + imports + run + last,
    }
    changed = {**files, **{name: files[name].replace(before, after) for name in ("near", "tables")}}
    results = []
    for state in (files, files, changed):
        for name, content in state.items():
            path = tmp_path / f"{name}.py"
            if not path.exists() or path.read_text() != content:
                path.write_text(content)
        program = (
            "import loops; print(loops.run(2.0), sum(loops.run.stats.cache_hits.values()), loops.run.py_func(2.0))"
        )
        env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": f"{tmp_path}:{ROOT}"}
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path, env=env
        )
        results.append(tuple(map(float, done.stdout.split())))
    assert [kept > 0 for _, kept, _ in results] == [False, True, False]
    assert all(value == plain for value, _, plain in results)
    assert results[0][0] != results[2][0]


def test_a_loop_that_was_compiled_beside_its_file_is_read_where_this_process_keeps_its_own_elsewhere(tmp_path):
    """As in the image, whose code nobody may write to."""
    (tmp_path / "loops.py").write_text(
        "from workers.geometry.jit import compiled\n@compiled\ndef run(x):\n    return x + 1\n"
    )
    program = "import loops; print(loops.run(2.0), sum(loops.run.stats.cache_hits.values()))"

    def run(**settings: str) -> list[str]:
        env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
        env |= {"PYTHONPATH": f"{tmp_path}:{ROOT}", **settings}
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=env)
        return done.stdout.split()

    elsewhere = tmp_path / "kept"
    assert run() == ["3.0", "0"]
    assert run(NUMBA_CACHE_DIR=str(elsewhere)) == ["3.0", "1"]
    assert not list(elsewhere.rglob("*.nbc"))
    beside = tmp_path / "__pycache__"
    for file in beside.glob("*.nb[ci]"):
        file.unlink()
    assert run(NUMBA_CACHE_DIR=str(elsewhere)) == ["3.0", "0"]
    assert list(elsewhere.rglob("*.nbc"))


def test_two_processes_that_keep_a_loop_at_once_never_mix_up_its_types(tmp_path):
    """One writes its index, the other its index and its code, and then the first its code: under numba's names the same file."""
    one, two = (_LoopFile(str(tmp_path), "loop", "stamp") for _ in range(2))
    write = one._save_data

    def write_late(name: str, data: object) -> None:
        two.save("of floats", "code for floats")
        write(name, data)

    one._save_data = write_late
    two._load_index = dict  # as it was before the first wrote its own
    one.save("of ints", "code for ints")
    later = _LoopFile(str(tmp_path), "loop", "stamp")
    assert {later.load("of floats"), later.load("of ints")} <= {None}, "both only have to be compiled again"
    later.save("of floats", "code for floats")
    later.save("of ints", "code for ints")
    assert (later.load("of floats"), later.load("of ints")) == ("code for floats", "code for ints")
    assert _LoopFile(str(tmp_path), "loop", "another stamp").load("of ints") is None

"""Compiled loops: where they are kept, and the order in which they add."""

import subprocess
import sys

import numpy as np

from workers.geometry.jit import compiled


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

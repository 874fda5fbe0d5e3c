"""manifold3d starts no threads in a worker."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

COUNT = """
import os, re
import numpy as np
from workers.assets.builtin.make import make_model
from workers.geometry.hull import convex_hull
threads = lambda: int(re.search(r"Threads:\\s+(\\d+)", open("/proc/self/status").read()).group(1))
before, cores = threads(), os.sched_getaffinity(0)
for index in range(3):
    convex_hull(np.random.default_rng(index).random((50_000, 3)))
    convex_hull(make_model("camera", 0, index).solid.vertices)
print(threads() - before, os.sched_getaffinity(0) == cores)
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_booleans_and_hulls_start_no_threads_and_leave_the_process_its_cores():
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", COUNT], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "True"]

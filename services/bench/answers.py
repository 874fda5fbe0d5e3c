"""The inner end of a side process: answers one line of JSON with one line. It uses none of our code."""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

STEP_HZ, SECONDS = 240, 3.0
"""The simulation of every side, as such scripts have it."""

FLOOR, TABLE, OBJECT = 1, 2, 3
"""Region ids."""

OPTICAL_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Asked = dict[str, Any]


def answer_scenes(
    load: Callable[[dict[str, Any], Path, Asked], Any],
    make: Callable[[Any, Asked], dict[str, float]],
    finish: Callable[[Asked], None] = lambda asked: None,
) -> None:
    """Answer until there are no more lines.

    `load(described, folder, asked)` reads a scene's files before the clock; `make(loaded, asked)` returns seconds by stage;
    `finish(asked)` runs after the clock.
    """
    # Libraries talk on standard output, so that is moved.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    print(json.dumps({"ready": True}), file=answers)
    for line in sys.stdin:
        asked = json.loads(line)
        path, before = Path(asked["scene"]), time.perf_counter()
        loaded = load(json.loads(path.read_text()), path.parent, asked)
        wall, cpu = time.perf_counter(), time.process_time()
        stages = make(loaded, asked)
        answer = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu, "stages_s": stages}
        finish(asked)
        print(json.dumps(answer | {"load_s": wall - before}), file=answers)

"""Compiles the loops that scenes use beside the code, for the image: a container that starts from it reads them there.

With `--list` it makes scenes instead, all of them checked by casting rays, and writes workers/pipeline/loops.txt: to be done
where a loop is new or gets other arguments.
"""

import importlib
import multiprocessing
import os
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import workers
from services.job.job_file import load_job
from workers.assets.catalogue import open_catalogue
from workers.geometry.jit import used_by
from workers.physics.contact_surface import faces_within
from workers.pipeline.context import open_worker
from workers.pipeline.loops import LIST, compile_together
from workers.pipeline.run_shard import run_scene
from workers.pipeline.stopwatch import Stopwatch

JOBS = Path(__file__).parent / "jobs"

SCENES = {("tabletop.yaml", "raster"): 64, ("tabletop.yaml", "flat"): 2, ("pile.yaml", "raster"): 1}
"""Scenes of each job and tier that the list is made from: so many that few loops are left."""


def make_scenes(scenes: Mapping[tuple[str, str], int]) -> None:
    """Make so many scenes of each job and tier in memory."""
    for (name, tier), count in scenes.items():
        job = load_job(JOBS / name, ["check.raycast_share=1", f"render.tier={tier}"])
        context = open_worker(job, open_catalogue(job.assets, JOBS, tuple(job.categories)))
        outputs = [run_scene(context, job.first_scene + number, Stopwatch()) for number in range(count)]
        print(f"{name}: {sum(bool(output.files) for output in outputs)} of {count} scenes made")


def touch_bodies() -> None:
    """Calls what one scene in 150 calls first, when a check lets its things go: of two bodies, the faces that nearly touch."""
    corners, faces = np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    faces_within((corners, faces), (corners + 0.1, faces), 0.5)


def all_loops() -> Iterator[Any]:
    """Every compiled loop of the workers."""
    for module in pkgutil.walk_packages(workers.__path__, "workers."):
        if "pathtraced" in module.name:  # needs its extra, and has no loop
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, Dispatcher) and value.py_func.__module__ == module.name:
                yield value


def write_list() -> None:
    """Make scenes with nothing kept from before, and list every loop that was compiled for them."""
    loops = list(all_loops())
    for loop in loops:
        loop._cache = NullCache()
    make_scenes(SCENES)
    touch_bodies()
    lines = []
    for loop in sorted(loops, key=lambda loop: (len(used_by(loop.py_func)), loop.__module__, loop.__name__)):
        lines += sorted(f"{loop.__module__} {loop.__name__} {types!r}" for types in loop.signatures)
    LIST.write_text("".join(f"{line}\n" for line in lines))
    print(f"{LIST}: {len(lines)} entries")


def compile_all() -> None:
    """Compile the list with a process for each core."""
    count = os.cpu_count() or 1
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as pool:
        taken = [pool.submit(compile_together) for _ in range(count)]
        print(f"{sum(share.result() for share in taken)} loops compiled")


if __name__ == "__main__":
    (write_list if sys.argv[1:] == ["--list"] else compile_all)()

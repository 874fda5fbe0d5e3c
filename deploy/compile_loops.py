"""Compiles the loops that scenes use, for the image: a container that starts from it has nothing to compile.

`NUMBA_CACHE_DIR` must be the folder `.loops` beside the code, where processes look for them (workers/geometry/jit.py).
"""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor

import workers.shard.run_shard  # noqa: F401  every file with loops for scenes
from workers.geometry.jit import compile_planned

if __name__ == "__main__":
    count = os.cpu_count() or 1
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as pool:
        taken = [pool.submit(compile_planned) for _ in range(count)]
        print(f"{sum(share.result() for share in taken)} loops compiled")

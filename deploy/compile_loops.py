"""Compiles the loops that scenes use, for the image: a container that starts from it has nothing to compile.

`NUMBA_CACHE_DIR` must be the folder `.loops` beside the code, where processes look for them (workers/geometry/jit.py). Every file
with loops for scenes is imported by workers.shard.run_shard; processes that start at once share them.
"""

import os
import subprocess
import sys

SHARE = (
    "import workers.shard.run_shard; from workers.geometry.jit import compile_planned; "
    "print(compile_planned(), 'loops compiled')"
)

if __name__ == "__main__":
    shares = [subprocess.Popen([sys.executable, "-c", SHARE]) for _ in range(os.cpu_count() or 1)]
    sys.exit(max(share.wait() for share in shares))

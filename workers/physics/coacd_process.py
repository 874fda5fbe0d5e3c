"""CoACD in a process of its own: its exceptions end the process, and its memory must not affect the next mesh.

A script, started by `workers.physics.convex_parts` and imported for `MISSING` alone. Reads `request.npz` in the given
folder (vertices [V, 3] float64, faces [F, 3] int32, options as JSON) and writes `parts.npz` there: vertices [N, 3] float64 of
all parts in turn, counts [P]. Exit code 3: the package is missing, or its library. The second argument is its limit of processor
time, whole seconds, at which SIGXCPU ends it; the third is that of its memory, MiB, at which CoACD gives up.
"""

import ctypes
import json
import os
import resource
import signal
import sys
from pathlib import Path

import numpy as np

MISSING = 3

PR_SET_PDEATHSIG = 1
"""The option of prctl(2) by which a process ends with its parent."""


def main(folder: Path, cpu_s: int, memory_mb: int) -> int:
    """Exit code."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, resource.RLIM_INFINITY))  # at a hard limit it would be SIGKILL
    resource.setrlimit(resource.RLIMIT_AS, (memory_mb << 20, memory_mb << 20))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})  # a worker has one core; OpenMP counts them on loading
    try:
        import coacd  # type: ignore[import-untyped]

        coacd.set_log_level("off")
    except (ImportError, NameError):  # the latter where the package is there and the library in it is not
        return MISSING
    finally:
        os.sched_setaffinity(0, allowed)
    with np.load(folder / "request.npz") as request:
        mesh = coacd.Mesh(request["vertices"], request["faces"])
        options = json.loads(str(request["options"]))
    clouds = [np.asarray(vertices, dtype=np.float64) for vertices, _ in coacd.run_coacd(mesh, **options)]
    np.savez(folder / "parts.npz", vertices=np.concatenate(clouds), counts=np.array([len(c) for c in clouds]))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))

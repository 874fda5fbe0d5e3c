"""manifold3d, held to one thread: it would start one for each core, in every worker."""

import functools
import os

import manifold3d


@functools.cache
def hold_to_one_thread() -> None:
    """To be called before manifold3d is used.

    Its pool of threads counts the cores that the calling thread may use when a boolean is first made, and never again:
    so the first one is made while only one core is allowed.
    """
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        cube = manifold3d.Manifold.cube()
        (cube + cube.translate((0.5, 0.3, 0.2))).num_tri()
    finally:
        os.sched_setaffinity(0, allowed)

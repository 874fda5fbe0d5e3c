"""Limit of manifold3d to one thread: by default it starts one for each core, in every worker."""

import functools
import os

import manifold3d


@functools.cache
def hold_to_one_thread() -> None:
    """Limits manifold3d's thread pool to one core; to be called before manifold3d is used.

    The pool counts the cores that the calling thread may use at the first boolean, and never again: so the first boolean
    is made while only one core is allowed.
    """
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        cube = manifold3d.Manifold.cube()
        (cube + cube.translate((0.5, 0.3, 0.2))).num_tri()
    finally:
        os.sched_setaffinity(0, allowed)

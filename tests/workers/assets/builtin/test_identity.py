"""The names of built-in instances, and what a coordinator need not load for them."""

import subprocess
import sys

from workers.assets.builtin.identity import instance_id


def test_ids_sort_as_their_numbers_do():
    ids = [instance_id("mug", 7, index) for index in (0, 9, 10, 99_999, 999_999)]
    assert ids == sorted(ids) and ids[1] == "mug-7-000009"


def test_opening_a_catalogue_of_built_in_shapes_loads_nothing_that_makes_them():
    """Their import took 0.6 s of a coordinator's start."""
    asks = (
        "import sys; from pathlib import Path; from schemas.job.job import Job;"
        "from workers.assets.catalogue import open_catalogue; job = Job(name='t');"
        "open_catalogue(job.assets, Path(), tuple(job.categories));"
        "print(sorted({'trimesh', 'numba', 'scipy', 'pybullet', 'pyrender'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", asks], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"

"""Verso in Python: `import verso; dataset = verso.open("data/tabletop")`.

Reading loads neither Ray, OpenGL nor PyBullet; `make_scene` loads what making a scene needs when it is called.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from schemas.errors import CorruptError, InputError, OutputError, SceneError, VersoError, needs_making
from schemas.job.job import Job
from services.dataset.correspondence import Correspondence
from services.dataset.dataset import Dataset
from services.dataset.dataset import open_dataset as open
from services.dataset.pair import Pair
from services.dataset.view import Box, Cloud, Pixels, View

__all__ = [
    "Box",
    "Cloud",
    "Correspondence",
    "CorruptError",
    "Dataset",
    "InputError",
    "Job",
    "OutputError",
    "Pair",
    "Pixels",
    "SceneError",
    "VersoError",
    "View",
    "make_scene",
    "open",
]


def make_scene(
    job: str | Path | Mapping[str, Any] | Job, scene_id: int, changes: Sequence[str] = ()
) -> tuple[Pair, ...]:
    """The pairs of one scene, made in this process and kept in memory, with the bytes that a run would store.

    `job` is a job file, its keys, or a parsed job; `changes` are `KEY=VALUE` as in `--set`. Raises SceneError where the scene
    cannot be made, and InputError where the job is wrong.
    """
    with needs_making("verso.make_scene"):
        from services.dataset.one_scene import make_scene as make

    return make(job, scene_id, changes)

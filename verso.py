"""Verso in Python: `import verso; dataset = verso.open("data/tabletop")`.

Reading loads neither Ray, OpenGL nor PyBullet; `make_scene` loads what making a scene needs when it is called. What reads is
loaded when a name is first asked for: every command of an installed reader imports this file.
"""

from typing import TYPE_CHECKING, Any

from schemas.errors import CorruptError, InputError, OutputError, SceneError, VersoError

if TYPE_CHECKING:
    from schemas.job.job import Job
    from services.dataset.dataset import Dataset, make_scene
    from services.dataset.dataset import open_dataset as open
    from services.dataset.pair import Correspondence, Pair
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


def __getattr__(name: str) -> Any:
    """Loads the names of reading, all at once. Raises AttributeError for any other."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from schemas.job.job import Job
    from services.dataset.dataset import Dataset, make_scene, open_dataset
    from services.dataset.pair import Correspondence, Pair
    from services.dataset.view import Box, Cloud, Pixels, View

    names = {kind.__name__: kind for kind in (Box, Cloud, Correspondence, Dataset, Job, Pair, Pixels, View)}
    globals().update(names, open=open_dataset, make_scene=make_scene)
    return globals()[name]


def __dir__() -> list[str]:
    return __all__

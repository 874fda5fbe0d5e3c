"""Datasets of made-up scenes: committed ranges, and the rows that merging must give."""

import itertools

from schemas.dataset.tables import SORT_KEYS
from tests.made_up_scenes import attempt_at, scene, terms
from workers.store.local import LocalStore

FIRST, STOP = 3, 30


def dataset_at(root, first=FIRST, stop=STOP, size=4, layout="files", order=1, make=scene) -> LocalStore:
    """A folder with every range committed and nothing merged."""
    store = LocalStore(root)
    store.prepare()
    lines = [*range(first, stop, size), stop]
    for start, end in list(itertools.pairwise(lines))[::order]:
        attempt_at(store, start, end, terms(layout=layout, range_size=size, first_scene=first), make).commit()
    return store


def plain_rows(table: str, first=FIRST, stop=STOP, make=scene) -> list[dict]:
    """The rows that the dataset must hold, from the scenes themselves."""
    rows = [row for scene_id in range(first, stop) for row in make(scene_id).rows.get(table, ())]
    unique = {tuple(row[key] for key in SORT_KEYS[table]): row for row in rows}
    return [unique[key] for key in sorted(unique)]

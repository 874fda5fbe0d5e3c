"""One dataset in every form that it can be opened in."""

import shutil
from pathlib import Path

import obstore
import pytest
from obstore.store import MemoryStore

from services.dataset.dataset import Dataset, open_dataset
from tests.datasets import make_dataset
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

CHANGES = {"scenes": 4, "categories": ["mug", "laptop"], "pairs_per_scene": 2, "run": {"range_size": 2}}
SLOWER = ("tar", "running files", "running bucket")
"""Forms whose parts the other three have too."""

FORMS = ("files", "tar", "bucket", "running files", "running tar", "running bucket")


@pytest.fixture(scope="package")
def files(tmp_path_factory) -> LocalStore:
    """Four scenes of two pairs, finished."""
    return make_dataset(tmp_path_factory.mktemp("files"), **CHANGES)[0]


@pytest.fixture(scope="package")
def tars(tmp_path_factory) -> LocalStore:
    """The same in tars."""
    return make_dataset(tmp_path_factory.mktemp("tars"), output={"layout": "tar"}, **CHANGES)[0]


@pytest.fixture(scope="package")
def forms(files, tars, tmp_path_factory) -> dict[str, Dataset]:
    """The same scenes as files, in tars, and in a bucket; finished, and as if the merge were still to come."""
    opened = {}
    for word in ("", "running "):
        for name, store in (("files", files), ("tar", tars)):
            root = tmp_path_factory.mktemp("form") / name
            shutil.copytree(store.root, root)
            if word:
                unmerge(root)
            opened[word + name] = open_dataset(root)
        bucket = MemoryStore()
        for path in (path for path in root.rglob("*") if path.is_file()):
            obstore.put(bucket, path.relative_to(root).as_posix(), path)
        opened[word + "bucket"] = Dataset(ObjectStore(bucket, "memory://bucket"))
    return opened


@pytest.fixture(
    scope="package", params=[pytest.param(form, marks=pytest.mark.minute) if form in SLOWER else form for form in FORMS]
)
def dataset(request, forms) -> Dataset:
    return forms[request.param]


def unmerge(root: Path) -> None:
    """Takes away what only a finished dataset has."""
    (root / "_SUCCESS").unlink()
    for table in ("scenes", "views", "objects", "assets", "failures", "timings"):
        shutil.rmtree(root / "manifest" / table)

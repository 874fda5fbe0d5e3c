"""One dataset in every form that it can be opened in."""

import shutil
from pathlib import Path

import pytest

from schemas.dataset.tables import TABLES
from services.dataset.dataset import Dataset, open_dataset
from tests.datasets import in_a_bucket

FORMS = [
    *("files", "tar", "running bucket"),
    *(pytest.param(name, marks=pytest.mark.minute) for name in ("bucket", "running files", "running tar")),
]


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
        opened[word + "bucket"] = Dataset(in_a_bucket(root))
    return opened


@pytest.fixture(scope="package", params=FORMS)
def dataset(request, forms) -> Dataset:
    return forms[request.param]


@pytest.fixture
def copy(files, tmp_path) -> Path:
    """A copy of `files` that a test may damage."""
    shutil.copytree(files.root, tmp_path / "copy")
    return tmp_path / "copy"


def unmerge(root: Path) -> None:
    """Takes away what only a finished dataset has."""
    (root / "_SUCCESS").unlink()
    for table in TABLES:
        shutil.rmtree(root / "manifest" / table)

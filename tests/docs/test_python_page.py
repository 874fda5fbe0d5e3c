"""Every block of docs/python.md runs as it is printed."""

import shutil
from pathlib import Path

import pytest

from tests.datasets import make_dataset
from tests.pages import DOCS, blocks_of, run_blocks


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    """A folder with the dataset and the job that the page names."""
    root = tmp_path_factory.mktemp("here")
    make_dataset(root / "data/tabletop", scenes=6, categories=["mug", "can"])
    shutil.copytree(DOCS.parent / "deploy/jobs", root / "deploy/jobs")
    return root


def test_every_block_of_the_page_runs(here, monkeypatch, capsys):
    monkeypatch.chdir(here)
    page = DOCS / "python.md"
    assert len(blocks_of(page, "python")) >= 9
    names = run_blocks(page)
    assert names["pair"].scene_id == 17 and names["pair"].scene["pose"] == "tumbled"
    printed = capsys.readouterr().out.splitlines()
    assert sum("(120, 160, 3)" in line for line in printed) == 6
    assert "Columns of a pair" in printed[-1]


def test_the_filter_of_the_page_chooses_some_and_not_all(here, monkeypatch, capsys):
    monkeypatch.chdir(here)
    names: dict = {}
    blocks = blocks_of(DOCS / "python.md", "python")
    exec(blocks[0], names)
    capsys.readouterr()
    (filtering,) = [block for block in blocks if "textured" in block]
    exec(filtering, names)
    chosen = capsys.readouterr().out.splitlines()
    assert 0 < len(chosen) < 6 and all(line.startswith("mug-") for line in chosen)

"""The README: its Python runs as it is printed, and it stays short."""

from pathlib import Path

import cv2
import numpy as np

from tests.datasets import make_dataset
from tests.pages import run_blocks

README = Path(__file__).resolve().parents[2] / "README.md"
MOST_LINES = 120


def test_the_python_of_the_readme_reads_every_mug(tmp_path, monkeypatch):
    make_dataset(tmp_path / "data/tabletop", scenes=6, categories=["mug", "can"])
    monkeypatch.chdir(tmp_path)
    names = run_blocks(README)
    paths = sorted(Path("data/tabletop/mug").glob("RGB0*[02468].png"))  # every mug is seen whole
    assert len(paths) > 1
    assert sorted(names["files"]) == [str(path.relative_to("data/tabletop")) for path in paths]
    assert np.array_equal(names["images"], [cv2.imread(f"data/tabletop/{path}")[..., ::-1] for path in names["files"]])


def test_it_can_be_read_in_a_few_minutes():
    assert len(README.read_text().splitlines()) <= MOST_LINES

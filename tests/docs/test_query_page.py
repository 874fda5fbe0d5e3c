"""Every block of docs/query.md runs as it is printed, and answers what plain files say."""

import json
import shlex
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from services.cli.main import main
from tests.datasets import make_dataset
from tests.pages import DOCS, blocks_of, run_blocks


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    """A folder with the dataset that the page names."""
    root = tmp_path_factory.mktemp("here")
    make_dataset(root / "data/tabletop", scenes=6, categories=["mug", "can"])
    return root


def camera_poses(root: Path) -> dict[int, np.ndarray]:
    """Poses by id, from the text file."""
    lines = (root / "data/tabletop/camPoses.csv").read_text().splitlines()[1:]
    return {int(line.split(",")[0]): np.array(line.split(",")[2:], float).reshape(4, 4) for line in lines}


def test_the_python_of_the_page_answers(here, monkeypatch):
    monkeypatch.chdir(here)
    names = run_blocks(DOCS / "query.md")
    paths = sorted(
        str(path.relative_to("data/tabletop")) for path in Path("data/tabletop/mug").glob("RGB0*[02468].png")
    )
    assert names["files"] == paths and len(paths) > 1  # every mug is seen whole
    pixels = [cv2.imread(f"data/tabletop/{path}")[..., ::-1] for path in paths]
    assert np.array_equal(names["images"], pixels) and np.array_equal(names["batch"], pixels)
    assert 0 < names["rows"].num_rows <= 6
    dat = [line.split() for line in Path("data/tabletop/objects.dat").read_text().splitlines()]
    places = {(int(w[0]), w[2], int(w[4]), int(w[5])) for w in dat if w[3] != "2" and int(w[0]) % 2}
    joined = names["joined"].to_pylist()
    assert {(row["pose_id"], row["instance_id"], row["u"], row["v"]) for row in joined} == places
    poses = camera_poses(here)
    assert all(any(np.allclose(T, pose) for T in names["T_world_cam"]) for pose in poses.values())


def test_the_commands_of_the_page_answer(here, monkeypatch, capfdbinary):
    monkeypatch.chdir(here)
    answers = []
    for line in "".join(blocks_of(DOCS / "query.md", "sh")).splitlines():
        program, *words = shlex.split(line)
        assert program == "verso"
        if ">" in words and not words[-1].isdigit():
            words = words[:-2]
        assert main(words) == 0
        answers.append(capfdbinary.readouterr().out)
    table, csv, listed, paths, parquet, columns = answers
    assert table.splitlines()[-1] == b"(2 rows)" and b"settle_s" in table
    assert csv.splitlines()[0] == b"scene_id,role,u,v" and len(csv.splitlines()) > 6
    assert {row["scene_id"] for row in json.loads(listed)} <= set(range(6))
    assert all((here / "data/tabletop" / path.decode()).is_file() for path in paths.splitlines()[1:])
    (here / "views.parquet").write_bytes(parquet)
    assert pq.read_table(here / "views.parquet").num_rows == 24
    assert b"T_world_cam" in columns

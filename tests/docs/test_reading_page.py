"""Every block of README.md and docs/reading.md runs as it is printed, and answers what plain files say."""

import json
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from services.cli.main import main
from tests.datasets import make_dataset
from tests.docs.test_pages import ROOT, blocks


def blocks_of(page: str, wanted: str) -> list[str]:
    """The fenced blocks of a page in one language, in order."""
    return [text for language, _, text in blocks(page) if language == wanted]


def run_blocks(page: str) -> dict:
    """Runs the Python blocks of a page one after the other, in one namespace, which comes back."""
    names: dict = {}
    for number, block in enumerate(blocks_of(page, "python")):
        exec(compile(block, f"{page}, block {number + 1}", "exec"), names)
    return names


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    """A folder with the dataset and the job that the page names."""
    root = tmp_path_factory.mktemp("here")
    shutil.copytree(ROOT / "deploy/jobs", root / "deploy/jobs")
    make_dataset(root / "data/tabletop", scenes=6, categories=["mug", "can"])
    return root


def check_images_of_mugs(names):
    lines = Path("data/tabletop/camPoses.csv").read_text().splitlines()[1:]
    poses = {int(words[0]): float(words[2 + 10]) for words in (line.split(",") for line in lines)}  # element [2, 2]
    mugs = {int(path.stem[3:]): path for path in Path("data/tabletop/mug").glob("RGB0*[02468].png")}
    paths = sorted(str(path) for number, path in mugs.items() if np.arcsin(-poses[number]) > 0.8)
    assert sorted(f"data/tabletop/{path}" for path in names["files"]) == paths and 0 < len(paths) < len(mugs)
    pixels = [cv2.imread(f"data/tabletop/{path}")[..., ::-1] for path in names["files"]]
    assert np.array_equal(names["images"], pixels)


def test_the_readme_reads_every_mug_and_can_be_read_in_a_few_minutes(here, monkeypatch):
    monkeypatch.chdir(here)
    check_images_of_mugs(run_blocks("README.md"))
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_the_python_of_the_page_answers(here, monkeypatch, capsys):
    monkeypatch.chdir(here)
    names = run_blocks("docs/reading.md")
    assert names["made"].scene_id == 17
    printed = capsys.readouterr().out.splitlines()
    assert sum("(120, 160, 3)" in line for line in printed) == 6
    chosen = [line for line in printed if line.startswith(("mug-", "can-"))]  # by the filter of `pairs`
    assert 0 < len(chosen) < 6 and all(line.startswith("mug-") for line in chosen)
    assert "Columns of a pair" in printed[-1]
    assert 0 < names["rows"].num_rows <= 6
    dat = [line.split() for line in Path("data/tabletop/objects.dat").read_text().splitlines()]
    places = {(int(w[0]), w[2], int(w[4]), int(w[5])) for w in dat if w[3] != "2" and int(w[0]) % 2}
    joined = names["joined"].to_pylist()
    assert {(row["pose_id"], row["instance_id"], row["u"], row["v"]) for row in joined} == places
    lines = Path("data/tabletop/camPoses.csv").read_text().splitlines()[1:]
    poses = [np.array(line.split(",")[2:], float).reshape(4, 4) for line in lines]
    assert all(any(np.allclose(T, pose) for T in names["T_world_cam"]) for pose in poses)


def test_the_commands_of_the_page_answer(here, monkeypatch, capfdbinary):
    monkeypatch.chdir(here)
    answers = []
    for line in "".join(blocks_of("docs/reading.md", "sh")).splitlines():
        program, *words = shlex.split(line)
        assert program == "verso"
        if ">" in words and not words[-1].isdigit():
            words = words[:-2]
        assert main(words) == 0
        answers.append(capfdbinary.readouterr().out)
    table, csv, listed, paths, parquet, columns = answers
    assert b"settle_s" in table and b"mug" in table
    assert csv.splitlines()[0] == b"scene_id,role,u,v" and len(csv.splitlines()) > 6
    assert {row["scene_id"] for row in json.loads(listed)} <= set(range(6))
    assert all((here / "data/tabletop" / path.decode()).is_file() for path in paths.splitlines()[1:])
    (here / "views.parquet").write_bytes(parquet)
    assert pq.read_table(here / "views.parquet").num_rows == 24
    assert b"T_world_cam" in columns

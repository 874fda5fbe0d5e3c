"""docs/own_meshes.md: its commands are run, and its tables are the code's."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from services.cli.main import main
from services.init.collection import SUFFIXES
from services.job.bounded_yaml import parse_yaml
from tests.own_meshes import mixed_folder

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "own_meshes.md").read_text()
LINES = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]
COMMANDS = [shlex.split(line)[1:] for line in LINES]


@pytest.fixture
def home(tmp_path, monkeypatch):
    mixed_folder(tmp_path / "meshes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_its_commands_run_as_printed_but_for_the_scenes_themselves(home, capsys):
    quick = [words for words in COMMANDS if words[0] != "run" or "--dry-run" in words]
    assert len(quick) == len(COMMANDS) - 1 == 4
    for words in quick:
        assert main(words) == 0, words
    assert {path.name for path in home.iterdir()} == {
        *("meshes", "meshes.yaml", "meshes.jpg", "by_file.yaml", "by_file.jpg", "one.yaml", "one.png")
    }
    assert "categories: 002_can 1, bottles 1" in capsys.readouterr().out


@pytest.mark.ray
@pytest.mark.minute
def test_its_first_three_commands_make_a_dataset_in_which_everything_stands(home):
    for words in COMMANDS[:3]:
        subprocess.run(
            [sys.executable, "-m", "services.cli.main", *words], env=_environment(), check=True, capture_output=True
        )
    import pyarrow.dataset as ds

    scenes = ds.dataset(home / "data/meshes/manifest/scenes", partitioning="hive").to_table().to_pylist()
    assert len(scenes) == 8 and len({row["category"] for row in scenes}) > 2
    assets = ds.dataset(home / "data/meshes/manifest/assets", partitioning="hive").to_table().to_pylist()
    heights = {row["path"]: row["extents_m"][2] for row in assets if row["source"] == "urdf"}
    true = {"mugs/mug_0.glb": 0.08, "mugs/mug_1.glb": 0.1, "mugs/mug_2.glb": 0.12, "gltf cup/model.gltf": 0.1}
    assert {path: true[path] for path in heights if path in true} == pytest.approx(
        {path: height for path, height in heights.items() if path in true}, abs=1e-6
    )


def _environment():
    import os

    return {**os.environ, "PYTHONPATH": str(ROOT)}


def test_every_format_that_is_read_has_its_line_and_the_example_of_up_is_one():
    rows = "".join(line.split("|")[1] for line in PAGE.splitlines() if line.startswith("| `."))
    assert set(re.findall(r"`(\.\w+)`", rows)) == set(SUFFIXES)
    assert parse_yaml(re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[0])["up"]["**/*.glb"] == "y"

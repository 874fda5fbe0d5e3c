"""`verso capture process`, by the command line."""

import json

from services.cli.main import main
from tests.workers.pipeline.captures.small_capture import VIEWS, copy_of, made


def test_the_command_writes_results_and_answers_in_json(tmp_path, capsys):
    path = copy_of(made(), tmp_path)
    assert main(["capture", "process", str(path), "--set", "captures.fusion.voxel_m=0.003", "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    answer = json.loads(lines[-1])
    assert answer["ok"] and answer["estimate"] == "joint" and answer["views"] == VIEWS and answer["points"] > 1000
    assert [line.split()[0] for line in lines[:3]] == ["markers", "article", "joint"]
    record = json.loads((path / "process.json").read_bytes())
    assert record["settings"]["fusion"]["voxel_m"] == 0.003 and answer["seconds"] == record["seconds"]


def test_the_estimate_is_that_of_the_option_and_a_refusal_is_told(tmp_path, capsys):
    path = copy_of(made(), tmp_path)
    assert main(["capture", "process", str(path), "--estimate", "markers", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["estimate"] == "markers"
    assert main(["capture", "process", str(tmp_path / "nowhere")]) != 0
    assert "is no folder" in capsys.readouterr().err

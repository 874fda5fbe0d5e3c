"""`verso capture synthesize`, by the command line."""

import json

from services.cli.main import main
from tests.workers.pipeline.captures.small_capture import copy_of, made, processed


def test_a_view_from_a_pose_file(tmp_path, capsys):
    path = processed()[0]
    pose = path / "board_00003.txt"
    assert main(["capture", "synthesize", str(path), "--pose", str(pose), "--out", str(tmp_path / "v"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert answer["ok"] and len(answer["views"]) == 1 and answer["views"][0]["sources"][0] == 3
    assert (tmp_path / "v" / "depth_00000.png").is_file()


def test_mirror_views_lie_below_the_capture_by_default(tmp_path, capsys):
    path = copy_of(processed()[0], tmp_path)
    assert main(["capture", "synthesize", str(path), "--mirror"]) == 0
    assert "10 views" in capsys.readouterr().out
    assert len(list((path / "views").glob("rgb_*.png"))) == 10


def test_a_missing_pose_and_a_capture_that_was_not_processed_are_told(tmp_path, capsys):
    assert main(["capture", "synthesize", str(processed()[0]), "--pose", str(tmp_path / "no.txt")]) == 2
    assert "T_board_cam" in capsys.readouterr().err
    assert main(["capture", "synthesize", str(made()), "--mirror", "--out", str(tmp_path / "v")]) != 0
    assert "verso capture process" in capsys.readouterr().err

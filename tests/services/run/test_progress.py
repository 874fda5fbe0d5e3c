import json
import logging
import os
import subprocess
import sys
from pathlib import Path

from schemas.dataset.layout import LOG_FOLDER
from services.run import progress as module
from services.run.progress import ProgressLine, event_log, log_event, note_of_first_start

ROOT = Path(__file__).resolve().parents[3]


def test_events_are_json_lines_in_the_log_while_it_is_open(tmp_path):
    with event_log(tmp_path):
        log_event("worker lost", logging.WARNING, scene=3)
    log_event("too late")
    (line,) = (tmp_path / LOG_FOLDER / "verso.jsonl").read_text().splitlines()
    event = json.loads(line)
    assert (event["level"], event["event"], event["scene"]) == ("warning", "worker lost", 3)


def test_without_a_folder_there_is_no_log():
    with event_log(None):
        log_event("nowhere")


def test_a_log_has_a_few_lines_soon_and_then_one_a_minute(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    line = ProgressLine(20, "mugs")
    for now[0], done in (
        (101.0, 0),
        (104.0, 0),
        (105.0, 1),
        (120.0, 2),
        (140.0, 4),
        (170.0, 5),
        (219.0, 9),
        (222.0, 20),
    ):
        line.show(done, failed=1)
    line.close()
    assert capsys.readouterr().err.splitlines() == [
        "mugs: 0 of 20 scenes, 1 failed",
        "mugs: 2 of 20 scenes, 1 failed, 0.1 scenes/s, 3 min left",
        "mugs: 4 of 20 scenes, 1 failed, 0.1 scenes/s, 2.7 min left",
        "mugs: 5 of 20 scenes, 1 failed, 0.1 scenes/s, 3.5 min left",
        "mugs: 20 of 20 scenes, 1 failed, 0.2 scenes/s, 0 s left",
    ]


def test_a_terminal_that_tells_no_width_has_a_bar_too(tmp_path):
    """A new pseudo-terminal has no rows and no columns."""
    ours, theirs = os.openpty()
    code = "from services.run.progress import ProgressLine as P; p = P(4, 'mugs'); p.show(3, 1); p.close()"
    subprocess.run([sys.executable, "-c", code], stderr=theirs, check=True, cwd=ROOT)
    os.close(theirs)
    said = os.read(ours, 10_000).decode()
    os.close(ours)
    assert "3/4" in said
    assert "failed=1" in said


def test_the_start_is_told_to_take_longer_only_where_no_loop_was_compiled(tmp_path):
    assert note_of_first_start(tmp_path) == " (a first start compiles for up to a minute)"
    kept = tmp_path / "workers" / "geometry" / "__pycache__"
    kept.mkdir(parents=True)
    assert note_of_first_start(tmp_path) != ""
    (kept / "frames._transform-58.py311.nbi").touch()
    assert note_of_first_start(tmp_path) == ""

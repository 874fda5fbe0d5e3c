import json
import logging

from schemas.dataset.layout import LOG_FOLDER
from services.run import progress as module
from services.run.progress import ProgressLine, event_log, log_event


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


def test_elsewhere_than_on_a_terminal_there_is_one_line_a_minute(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    line = ProgressLine(20, "mugs")
    for now[0], done in ((130.0, 2), (161.0, 5), (200.0, 9), (222.0, 11)):
        line.show(done, failed=1)
    line.close()
    assert capsys.readouterr().err.splitlines() == [
        "mugs: 5 of 20 scenes, 1 failed, 0.1 scenes/s",
        "mugs: 11 of 20 scenes, 1 failed, 0.1 scenes/s",
    ]

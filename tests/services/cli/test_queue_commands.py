"""The queue's commands as typed: what they print, refuse and store."""

import json
from pathlib import Path

import pytest

from services.queue.queue import open_queue
from services.queue.supervise import hold_queue
from tests.kit.queue_world import ids, queue_of, request_of
from tests.services.cli.test_commands import TABLETOP, ended

ROOT = Path(__file__).resolve().parents[3]
HOSTILE = "$(touch x) `touch x`; touch x \"'\\"


@pytest.fixture
def queue(tmp_path, monkeypatch) -> str:
    monkeypatch.chdir(tmp_path)
    return str(tmp_path / "queue")


def test_submit_prints_the_id_alone_and_stores_what_was_asked(queue, capsys, tmp_path):
    asked = ["--scenes", "8", "--set", "start.pose=tumbled", "--priority", "-3", "--retry-failed"]
    code, out, err = ended(capsys, "submit", TABLETOP, "--queue", queue, *asked)
    assert code == 0
    (job,) = open_queue(queue).ids()
    assert out == f"{job}\n"
    request = open_queue(queue).read(job).request
    assert request.text == Path(TABLETOP).read_text()
    assert request.changes == ("scenes=8", "start.pose=tumbled")
    assert (request.name, request.scenes, request.priority, request.retry_failed) == ("tabletop", 8, -3, True)
    assert (request.out, request.folder) == (str(tmp_path / "data/tabletop"), str(ROOT / "deploy/jobs"))
    assert "no supervisor is running: `verso supervise --queue" in err
    with hold_queue(open_queue(queue)):
        assert "supervised by process" in ended(capsys, "submit", TABLETOP, "--queue", queue)[2]


REFUSED = (
    (["nowhere.yaml"], ["nowhere.yaml", "no such file"]),
    ([TABLETOP, "--set", "physcs.step_hz=3"], ["physcs", "did you mean 'physics'"]),
    (
        [TABLETOP, "--set", "assets.objects.0={source: library, folder: meshes}"],
        ["folder: 'meshes'", "write the whole path"],
    ),
    ([TABLETOP, "--set", "assets.objects.0={source: library, folder: ~/meshes}"], ["0.folder", "write the whole path"]),
)


def test_a_job_that_cannot_run_is_refused_with_exit_2_and_nothing_is_stored(queue, capsys):
    for arguments, words in REFUSED:
        code, out, err = ended(capsys, "submit", *arguments, "--queue", queue)
        assert (code, out) == (2, "") and all(word in err for word in words)
        assert not Path(queue).exists()
    faulty = [TABLETOP, "--set", "cameras.orbit.radius_m=-1"]
    assert ended(capsys, "submit", *faulty, "--queue", queue) == ended(capsys, "run", *faulty)


def test_text_that_a_shell_would_obey_is_kept_as_text(queue, capsys, tmp_path):
    job = tmp_path / "job.yaml"
    job.write_text(f"name: mugs\nscenes: 8\n# {HOSTILE}\n")
    code, out, _ = ended(capsys, "submit", str(job), "--queue", queue, "--out", f"/o {HOSTILE}")
    assert code == 0
    request = open_queue(queue).read(out.strip()).request
    assert (request.out, request.text) == (f"/o {HOSTILE}", job.read_text())
    assert ended(capsys, "submit", str(job), "--queue", queue, "--out", "/o\nx")[0] == 2
    assert ended(capsys, "submit", str(job), "--queue", queue, "--set", f"name={HOSTILE}")[0] == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["job.yaml", "queue"]


def test_a_queue_or_a_job_that_is_none_is_told_in_one_line(queue, capsys, tmp_path):
    for command in (["jobs"], ["logs", "j00000001"], ["cancel", "j00000001"]):
        for place, words in ((queue, "no such folder"), (str(tmp_path), "holds no queue.json")):
            code, out, err = ended(capsys, *command, "--queue", place)
            assert (code, out, err.count("\n")) == (2, "", 1)
            assert place in err and words in err
        code, _, err = ended(capsys, *command)
        which = "which queue? name it by --queue URL or in the environment variable VERSO_QUEUE"
        assert (code, err) == (2, f"verso: {which}\n")
    queue_of(Path(queue))
    for name in ("logs", "cancel"):
        code, _, err = ended(capsys, name, "j00000009", "--queue", queue)
        assert (code, err) == (2, f"verso: {queue} has no job j00000009: `verso jobs` lists those that there are\n")


def test_jobs_for_people_and_for_programs(queue, capsys):
    assert ended(capsys, "submit", TABLETOP, "--queue", queue, "--json")[0] == 0
    code, out, err = ended(capsys, "jobs", "--queue", queue, "--json")
    *table, last = out.splitlines()
    answer = json.loads(last)
    assert code == 0 and answer["ok"] and answer["queue"] == queue
    (row,) = answer["jobs"]
    assert (row["name"], row["state"]) == ("tabletop", "queued")
    assert (row["attempts"], row["scenes_done"], row["scenes_asked"]) == (0, 0, 64)
    assert table[1].startswith(f"{row['id']}  tabletop  0         queued  0         0/64")
    assert "no supervisor is running" in err


def test_cancel_ends_a_waiting_job_at_once_and_a_running_one_by_its_supervisor(queue, capsys):
    first, second, third = ids(3)
    made = queue_of(Path(queue), request_of(first), request_of(second), request_of(third))
    made.append(second, "started", 1)
    code, out, _ = ended(capsys, "cancel", first, "--queue", queue)
    assert (code, out) == (0, f"{first}: cancelled\n")
    for _ in range(2):  # asked again, it says the same
        code, out, err = ended(capsys, "cancel", second, "--queue", queue)
        assert (code, out) == (0, f"{second}: cancelling\n")
        assert "what is committed in /out/" in err
    assert ended(capsys, "cancel", first, "--queue", queue)[:2] == (0, f"{first}: cancelled\n")
    made.append(third, "started", 1)
    made.append(third, "began", 1)
    made.append(third, "ended", 1, code=1)
    code, out, err = ended(capsys, "cancel", third, "--queue", queue)
    assert (code, out, err) == (1, "", f"verso: job {third} is failed: there is nothing to cancel\n")


def test_logs_of_a_job_whose_cluster_is_gone(queue, capsys):
    (job,) = ids(1)
    made = queue_of(Path(queue), request_of(job))
    assert "nothing is known of what it wrote" in ended(capsys, "logs", job, "--queue", queue)[2]
    for kind in ("started", "began"):
        made.append(job, kind, 1)
    code, _, err = ended(capsys, "logs", job, "--queue", queue, "--address", "http://127.0.0.1:1")
    assert code == 1 and "no copy of its log is in the queue yet" in err
    made.append(job, "ended", 1, code=0)
    made.put_log(job, 1, "8 scenes made\n")
    assert ended(capsys, "logs", job, "--queue", queue)[1] == "--- attempt 1 ---\n8 scenes made\n"
    code, out, _ = ended(capsys, "logs", job, "--queue", queue, "--follow", "--json")
    assert (code, out.splitlines()[:2]) == (0, ["--- attempt 1 ---", "8 scenes made"])
    assert json.loads(out.splitlines()[-1])["state"] == "done"


def test_the_queue_may_be_named_by_the_environment(queue, capsys, monkeypatch, tmp_path):
    queue_of(Path(queue))
    queue_of(tmp_path / "other", request_of("j00000001"))
    monkeypatch.setenv("VERSO_QUEUE", queue)
    assert ended(capsys, "jobs")[:2] == (0, f"{queue} has no jobs\n")
    assert "j00000001" in ended(capsys, "jobs", "--queue", str(tmp_path / "other"))[1]

"""The one pool: what it answers, how it limits an item, whom it blames, and what it keeps."""

import ctypes
import errno
import faulthandler
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from workers.pool import Answers, Ended, Limits, Pool, run_pool

ROOT = Path(__file__).resolve().parents[2]


def double(number):
    return str(2 * number).encode()


def free_memory():
    with open("/proc/self/statm") as pages:
        return resource.getrlimit(resource.RLIMIT_AS)[1] - int(pages.read().split()[0]) * resource.getpagesize()


def spin(_):
    while True:
        pass


def crash():
    faulthandler.disable()
    ctypes.string_at(0)


def fail(number):
    raise OSError(number, "x")


def interrupt():
    signal.raise_signal(signal.SIGINT)
    return b"goes on"


ACTS = {
    "fine": lambda: b"fine",
    "pid": lambda: str(os.getpid()).encode(),
    "limits": lambda: b"%d %d" % (free_memory() >> 20, resource.getrlimit(resource.RLIMIT_FSIZE)[1] >> 20),
    "endless": lambda: spin(0),
    "asleep": lambda: time.sleep(1e6),
    "crash": crash,
    "memory": lambda: bytes(8 << 30),
    "file": lambda: fail(errno.EFBIG),
    "exit": lambda: os._exit(3),
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "fault": lambda: 1 / 0,
    "ctrl-c": interrupt,
}


def act(name):
    return ACTS[name.partition(" ")[0]]()


def act_in_log(item):
    log, name = item
    with log.open("a") as file:
        file.write(f"{name}\n")
    return act(name)


def test_every_item_is_answered_once_in_any_order():
    assert sorted(run_pool(double, range(20), processes=2)) == [(k, str(2 * k).encode()) for k in range(20)]


def test_a_child_answers_as_many_items_as_its_batch():
    for batch, children in ((None, 1), (2, 3)):
        items = [f"pid {k}" for k in range(6)]
        pids = [answer for _, answer in run_pool(act, items, processes=1, batch=batch)]
        assert len(set(pids)) == children


@pytest.mark.parametrize(
    ("name", "how", "detail"),
    [
        pytest.param("endless", "cpu", "more than 1 s of processor time", marks=pytest.mark.minute),
        ("memory", "memory", "more than 2048 MiB of memory"),
        ("file", "memory", "more than 2048 MiB"),
        pytest.param("asleep", "wall", "more than 4 s", marks=pytest.mark.minute),
        ("crash", "crashed", "SIGSEGV"),
        ("exit", "crashed", "exit code 3"),
        ("killed", "killed", "killed from outside"),
    ],
)
def test_an_item_that_ends_its_process_is_told_and_the_others_are_answered(name, how, detail):
    limits = Limits(memory_mb=2048, cpu_s=1.0, wall_s=4.0 if how == "wall" else 120.0)
    answers = dict(run_pool(act, ["fine 1", name, "fine 2"], processes=1, limits=limits))
    assert answers.pop("fine 1") == answers.pop("fine 2") == b"fine"
    end = answers.pop(name)
    assert not answers and isinstance(end, Ended) and end.how == how and detail in end.detail


def test_an_item_is_blamed_only_where_its_child_had_read_nothing_before(tmp_path):
    log = tmp_path / "log"
    list(run_pool(act_in_log, [(log, name) for name in ("fine", "crash", "fine 2")], processes=1))
    assert log.read_text().split("\n")[:-1].count("crash") == 2  # behind `fine`, and alone
    assert log.read_text().count("fine 2") == 1


def test_limits_hold_in_the_child():
    ((_, answer),) = run_pool(act, ["limits"], limits=Limits(memory_mb=1500))
    memory_mb, file_mb = map(int, answer.split())
    assert 1400 < memory_mb <= 1500, "what a child had loaded before its first item does not count"
    assert file_mb == 1500


def test_a_fault_of_the_work_is_raised_with_its_traceback():
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        list(run_pool(act, ["fault"]))


def test_ctrl_c_is_left_to_the_process_that_asks():
    assert dict(run_pool(act, ["ctrl-c"])) == {"ctrl-c": b"goes on"}


def test_what_is_kept_is_not_asked_again_and_bad_items_are_kept_as_bad(tmp_path):
    log, names = tmp_path / "log", ("fine", "exit", "killed")
    for asked in (4, 5):  # `exit` twice, because another had been answered before it; a kill is no verdict
        kept = Answers(tmp_path / "answers")
        items = [(log, name) for name in names]
        answers = dict(run_pool(act_in_log, items, key=lambda item: item[1], kept=kept, processes=1))
        assert answers[log, "fine"] == b"fine" and answers[log, "exit"].how == "crashed"
        assert len(log.read_text().split()) == asked


def test_items_are_asked_for_when_a_child_is_free_and_may_follow_from_answers():
    seen = []

    def items():
        yield 1
        while len(seen) < 5:
            yield int(seen[-1])

    with Pool(double, processes=1) as pool:
        seen += [0]
        for _, answer in pool.run(items()):
            seen.append(answer)
        assert seen[1:] == [b"2", b"4", b"8", b"16"]
        assert list(pool.run([7])) == [(7, b"14")]  # and the same children serve the next run


@pytest.mark.minute
def test_nothing_begins_after_the_deadline_and_what_is_late_is_ended():
    begun = time.monotonic()
    items = iter(["fine", "asleep", "fine 2"])
    answers = list(run_pool(act, items, processes=1, deadline=begun + 3.0, latest=begun + 4.0))
    assert answers == [("fine", b"fine")] and next(items) == "fine 2"
    assert time.monotonic() - begun < 60.0


def test_a_caller_that_stops_half_way_leaves_no_process():
    with Pool(act, processes=2) as pool:
        next(iter(pool.run(["pid", "asleep"])))
        pids = [child._process.pid for child in pool._children]
    time.sleep(0.1)
    assert pids and not any(Path(f"/proc/{pid}").exists() for pid in pids)


@pytest.mark.minute
def test_children_end_with_a_killed_asker(tmp_path):
    script = tmp_path / "ask.py"
    script.write_text(
        "from tests.workers.test_pool import act\nfrom workers.pool import run_pool\n"
        "if __name__ == '__main__':\n"
        "    for _, answer in run_pool(act, ['pid', 'asleep'], processes=1): print(answer.decode(), flush=True)\n"
    )
    path = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, env=path) as asker:
        child = Path(f"/proc/{int(asker.stdout.readline())}")
        assert child.exists()
        asker.kill()
    for _ in range(100):
        if not child.exists():
            return
        time.sleep(0.1)
    raise AssertionError("a child outlived its asker")


# ---------------------------------------------------------------------------------------------------- answers

VALUES = {"a": b"", "b c": b"x\n@y" * 5, "d": bytes(range(256)) * 40}


def fill(path):
    answers = Answers(path)
    for key, value in VALUES.items():
        answers.put(key, value)
    return answers


def test_answers_come_back_in_this_process_and_in_the_next(tmp_path):
    for answers in (fill(None), fill(tmp_path / "a/b"), Answers(tmp_path / "a/b")):
        assert {key: answers.get(key) for key in answers} == VALUES
        assert answers.get("z") is None and "z" not in answers


def test_a_record_that_is_cut_or_changed_at_any_byte_is_asked_again_and_harms_no_other(tmp_path):
    path = tmp_path / "answers"
    fill(path)
    whole = path.read_bytes()
    for at in [*range(120), *range(120, len(whole), 997), len(whole) - 1]:
        for data in (whole[:at], whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]):
            path.write_bytes(data)
            answers = Answers(path)
            assert all(answers.get(key) == VALUES[key] for key in answers)
            answers.put("last", b"1")
            answers = Answers(path)
            assert answers.get("last") == b"1" and len(answers) >= (len(data) == len(whole)) * 2


def test_two_processes_keep_answers_in_one_file(tmp_path):
    first, second = Answers(tmp_path / "a"), Answers(tmp_path / "a")
    for k in range(10):
        (first, second)[k % 2].put(str(k), bytes([k]) * k)
    both = Answers(tmp_path / "a")
    assert [both.get(str(k)) for k in range(10)] == [bytes([k]) * k for k in range(10)]
    assert first.get("8") == bytes([8]) * 8 and second.get("9") == bytes([9]) * 9


def test_answers_stay_in_memory_where_the_file_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    answers = fill(tmp_path / "file" / "below")
    assert {key: answers.get(key) for key in answers} == VALUES

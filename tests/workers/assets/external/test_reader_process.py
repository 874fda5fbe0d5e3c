"""The child that reads: its limits, and what it answered before it came to one."""

import ctypes
import errno
import faulthandler
import json
import resource
import signal
import socket
import time

import pytest

from workers.assets.external.answers import read_answers
from workers.assets.external.reader_process import (
    NO_MEMORY,
    Limits,
    _serve,
    _work,
    receive,
    send,
)


def serve(answer, count=1, memory_mb=4096, cpu_s=20.0):
    """How a child that answers `count` tasks ended, and its answers."""
    asked, asker = socket.socketpair()
    with asked, asker:

        def work(*given):
            asked.close()
            _work(Limits(memory_mb, cpu_s), lambda number: (b"+", [answer(number)]), asker, *given)

        _serve(work, count, asker)
        head, files, _, _ = socket.recv_fds(asked, 4096, 1)
    with open(files[0], "rb") as answers:
        answers.seek(0)
        return json.loads(head), [bytes(blocks).rstrip(b"\0") for _, blocks in read_answers(memoryview(answers.read()))]


def test_answers_come_back_in_their_order_with_what_they_cost():
    head, answers = serve(lambda number: b"abc"[number : number + 1] * 3, count=3)
    assert (head["exit"], answers) == (0, [b"aaa", b"bbb", b"ccc"])
    assert head["cpu_s"] < 5 and head["rss_kb"] > 1000


def endless(number):
    while number == 1:
        pass
    return b"done"


def test_processor_time_ends_a_task_and_not_the_answers_before_it():
    begun = time.perf_counter()
    head, answers = serve(endless, count=3, cpu_s=1.0)
    assert (head["exit"], answers) == (-signal.SIGXCPU, [b"done"])
    assert head["cpu_s"] < 4 and time.perf_counter() - begun < 60


def test_every_task_has_the_processor_time_for_itself():
    def half_a_second(number):
        begun = time.process_time()
        while time.process_time() < begun + 0.6:
            pass
        return b""

    head, _ = serve(half_a_second, count=4, cpu_s=1.0)
    assert head["exit"] == 0 and head["cpu_s"] > 2


def test_memory_ends_a_task():
    head, _ = serve(lambda number: bytes(8 << 30))
    assert head["exit"] == NO_MEMORY and head["rss_kb"] < 4 << 20


def test_answers_may_not_grow_without_bounds():
    def answer(number):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
        return b"a" * (600 << 10)

    head, answers = serve(answer, count=3)
    assert head["exit"] == NO_MEMORY and [len(one) for one in answers[:1]] == [600 << 10]


def test_a_crash_leaves_no_core_and_tells_its_signal(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def crash(number):
        faulthandler.disable()
        return ctypes.string_at(0) if number else b"first"

    head, answers = serve(crash, count=2)
    assert (head["exit"], answers) == (-signal.SIGSEGV, [b"first"])
    assert list(tmp_path.iterdir()) == []


def limits_of(number):
    kinds = (resource.RLIMIT_AS, resource.RLIMIT_FSIZE, resource.RLIMIT_CORE)
    return json.dumps([resource.getrlimit(kind)[1] for kind in kinds]).encode()


def test_limits_are_hard_ones():
    _, (answer,) = serve(limits_of)
    assert json.loads(answer) == [4096 << 20, 4096 << 20, 0]


@pytest.mark.parametrize(("number", "code"), [(errno.ENOMEM, NO_MEMORY), (errno.EFBIG, NO_MEMORY), (errno.EIO, 1)])
def test_errors_of_the_system_tell_memory_from_others(number, code):
    def fail(_):
        raise OSError(number, "x")

    assert serve(fail)[0]["exit"] == code


def test_a_message_is_read_whole_or_not_at_all():
    source, to = socket.socketpair()
    with source, to:
        send(to, b"abc")
        to.sendall(b"\5" + bytes(7) + b"ab")
        to.shutdown(socket.SHUT_WR)
        assert (receive(source), receive(source), receive(source)) == (b"abc", None, None)

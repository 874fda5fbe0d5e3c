"""What a driver tells the queue: it begins once, and only what it says itself is an end."""

import pytest

from schemas.errors import CorruptError, InUseError, OutputError, RunError
from services.queue.drivers import Ending, drive
from tests.kit.queue_world import ids, queue_of, request_of

(A,) = ids(1)


@pytest.fixture
def queue(tmp_path):
    made = queue_of(tmp_path / "q", request_of(A))
    made.append(A, "started", 1)
    return made


def test_a_driver_gets_the_request_and_tells_its_end(queue):
    asked = []

    def work(request):
        asked.append(request)
        assert queue.read(A).began
        return Ending(0, scenes=8, digest="d" * 64)

    assert drive(queue, A, 1, work) == 0
    view = queue.read(A)
    assert asked == [request_of(A)]
    assert (view.state, view.scenes, view.digest) == ("done", 8, "d" * 64)


@pytest.mark.parametrize("error", [OutputError("belongs to another job\nkeys"), CorruptError("torn"), RunError("1 %")])
def test_what_the_command_says_itself_is_an_end(queue, error):
    def work(request):
        raise error

    with pytest.raises(type(error)):
        drive(queue, A, 1, work)
    view = queue.read(A)
    assert (view.state, view.code) == ("failed", error.exit_code)
    assert view.note == " ".join(str(error).split())


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(1), OSError("no route"), ZeroDivisionError()])
def test_an_interruption_or_a_bug_is_not_told_and_so_counts_as_a_death(queue, error):
    def work(request):
        raise error

    with pytest.raises(type(error)):
        drive(queue, A, 1, work)
    assert (queue.read(A).state, queue.read(A).began) == ("running", True)


def test_a_folder_in_use_is_waited_for(queue):
    def work(request):
        raise InUseError("/out/a is in use by process 7 on host: wait", "/out/a", "process 7 on host")

    with pytest.raises(InUseError):
        drive(queue, A, 1, work)
    view = queue.read(A)
    assert (view.state, view.deaths) == ("waiting", 0)
    assert view.note.startswith("/out/a is in use")


@pytest.mark.parametrize("before", ["began:1", "cancel", "died:1", "died:1 started:2"])
def test_a_driver_whose_turn_it_is_not_does_nothing(queue, before):
    for word in before.split():
        kind, _, attempt = word.partition(":")
        queue.append(A, kind, int(attempt or 0))
    events = queue.read(A).events

    def work(request):
        raise AssertionError("it worked")

    with pytest.raises(RunError, match=f"job {A} is .*there is nothing to do for attempt 1"):
        drive(queue, A, 1, work)
    assert queue.read(A).events == events

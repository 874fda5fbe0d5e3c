"""Ray's job API where it cannot be used; a real one is in test_real_queue.py."""

import math
import socket

import pytest

from schemas.errors import CorruptError, InUseError, MachineError, OutputError, RunError
from services.queue.drivers import EVERY_S, Ending, RayDrivers, Sharing, drive
from services.run.ray_cluster import SharedSlots, Slots
from tests.kit.queue_world import ids, queue_of, request_of


def test_an_address_where_nothing_answers_is_told_in_one_line():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{unused.getsockname()[1]}"
        drivers = RayDrivers(address)
        for ask in (
            drivers.states,
            lambda: drivers.stop("verso-j00000001-1"),
            lambda: drivers.log("verso-j00000001-1"),
        ):
            with pytest.raises(
                MachineError, match=rf"^--address {address}: Ray's job API does not answer there[^\n]*$"
            ):
                ask()


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


def test_it_is_read_every_few_seconds_and_survives_a_store_that_fails(tmp_path):
    queue, now = queue_of(tmp_path / "q"), [0.0]
    sharing = Sharing(queue, lambda: now[0])
    seen = []
    for seconds, told in ((0.0, 2), (EVERY_S - 0.1, 3), (EVERY_S, 3), (2 * EVERY_S, 4), (3 * EVERY_S, None)):
        now[0] = seconds
        if told is None:
            (tmp_path / "q" / "share.json").unlink()
            (tmp_path / "q" / "share.json").mkdir()  # reading it raises
        else:
            queue.put_share(told)
        seen.append(sharing())
    assert seen == [2, 2, 3, 4, 4]


def test_even_shares_use_every_core_and_none_is_without():
    for cores in range(1, 20):
        for jobs in range(1, 6):
            slots = SharedSlots.of(Slots(cores, 2 * cores), lambda jobs=jobs: jobs).now()
            assert slots.in_flight == (2 * cores if jobs == 1 else math.ceil(cores / jobs))
            assert slots.in_flight >= 1
            assert jobs * slots.in_flight >= cores

"""A driver's share of the cluster."""

import math

from services.queue.drivers import EVERY_S, Sharing
from services.run.ray_cluster import SharedSlots, Slots
from tests.kit.queue_world import queue_of


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

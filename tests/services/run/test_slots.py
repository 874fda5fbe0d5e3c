"""Slots follow the cores of a cluster."""

from services.run.ray_cluster import LOOK_EVERY_S, PREFETCH, ClusterSlots, Slots, slots_of


def test_fixed_slots_stay():
    assert Slots(2, 4).now() == Slots(2, 4)


def test_a_cluster_has_a_slot_for_each_core_and_one_where_it_has_none():
    assert slots_of(6, None) == Slots(6, 6 * PREFETCH)
    assert slots_of(0, None) == Slots(1, PREFETCH)


def test_with_fewer_workers_than_cores_no_shard_waits():
    assert slots_of(6, 2) == Slots(2, 2)
    assert slots_of(2, 6) == Slots(2, 2 * PREFETCH)


def test_slots_grow_and_shrink_with_the_cluster_and_ask_it_now_and_then():
    cores, now, asked = [2], [100.0], []

    def count() -> int:
        asked.append(now[0])
        return cores[0]

    slots = ClusterSlots.of(count, None, clock=lambda: now[0])
    assert (slots.running, slots.in_flight) == (2, 2 * PREFETCH)
    seen = []
    for cores[0] in (2, 8, 0, 3):
        now[0] += LOOK_EVERY_S
        seen.append(slots.now().running)
        now[0] += LOOK_EVERY_S / 4
        assert slots.now().running == seen[-1]
    assert seen == [2, 8, 1, 3]
    assert len(asked) == 5

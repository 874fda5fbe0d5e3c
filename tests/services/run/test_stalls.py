"""Stalls are judged by what changes between two looks, never by a clock of another host."""

import pytest

from services.run.watchdog import AttemptName, Sight, find_stalls, look

MUG = AttemptName(16, "r0-1a2b3c4d-node_7.lab-4711-0123456789ab")
CAN = AttemptName(32, "r0-1a2b3c4d-node_8-4712-0123456789ab")
AGAIN = AttemptName(16, "r0-1a2b3c4d-node_8-9-ba9876543210")


def looks(*seen: dict[AttemptName, int | None], every_s: float = 10.0) -> dict[AttemptName, Sight]:
    known: dict[AttemptName, Sight] = {}
    for now in seen:
        known = look(known, now, every_s)
    return known


def test_an_attempts_name_tells_its_process():
    assert (MUG.host, MUG.pid) == ("node_7.lab", 4711)


def test_whoever_goes_on_to_another_scene_starts_anew():
    assert looks({MUG: 17}, {MUG: 17}, {MUG: 17})[MUG].idle_s == 20
    assert looks({MUG: 17}, {MUG: 17}, {MUG: 18})[MUG].idle_s == 0
    assert looks({MUG: 17}, {MUG: 17}, {MUG: None})[MUG].idle_s == 0


@pytest.mark.parametrize(("scene", "limit_s"), [(17, 15), (None, 50)])
def test_a_scene_may_take_longer_than_its_time_limit_and_a_commit_longer_still(scene, limit_s):
    assert find_stalls({MUG: Sight(scene, limit_s)}, 10.0) == {}
    assert find_stalls({MUG: Sight(scene, limit_s + 1), CAN: Sight(33, 1.0)}, 10.0) == {MUG: Sight(scene, limit_s + 1)}


def test_what_a_lost_worker_left_behind_is_not_taken_for_the_one_that_replaced_it():
    assert find_stalls({MUG: Sight(17, 100.0), AGAIN: Sight(17, 1.0)}, 10.0) == {}
    assert find_stalls({MUG: Sight(17, 100.0), AGAIN: Sight(17, 20.0)}, 10.0) == {AGAIN: Sight(17, 20.0)}


def test_an_attempt_that_has_ended_is_forgotten():
    assert looks({MUG: 17, CAN: 33}, {CAN: 33}) == {CAN: Sight(33, 10.0)}

"""Which deaths a run bears, and whom it blames."""

import pytest

from schemas.dataset.commit import Span
from schemas.errors import RunError
from services.run.coordinator import NODE_PATIENCE, Death, Deaths

SPAN = Span(start=4, stop=8)


def test_a_scene_is_blamed_after_as_many_deaths_as_attempts():
    deaths = Deaths(3)
    for _ in range(2):
        deaths.count(Death(4, 5, "time", ""))
    deaths.count(Death(4, 6, "killed", ""))
    assert deaths.blamed_in([SPAN]) == ()
    deaths.count(Death(4, 5, "memory", ""))
    (blame,) = deaths.blamed_in([SPAN])
    assert (blame.scene_id, blame.reason, blame.attempts) == (5, "memory", 3)
    assert deaths.blamed_in([Span(start=8, stop=12)]) == ()


def test_workers_that_die_before_they_begin_end_the_run():
    deaths = Deaths(2)
    deaths.count(Death(4, None, "killed", "why"))
    with pytest.raises(RunError, match=r"died 2 times before it began one.*why"):
        deaths.count(Death(4, None, "killed", "why"))


def test_a_lost_node_is_not_the_scenes_fault_until_it_happens_again_and_again():
    deaths = Deaths(1)
    for _ in range(NODE_PATIENCE - 1):
        deaths.count(Death(4, 5, "killed", "", with_node=True))
        deaths.count(Death(4, None, "killed", "", with_node=True))
    assert deaths.blamed_in([SPAN]) == ()
    deaths.count(Death(4, 5, "killed", "", with_node=True))
    assert deaths.blamed_in([SPAN])[0].attempts == NODE_PATIENCE
    with pytest.raises(RunError):
        deaths.count(Death(4, None, "killed", "", with_node=True))

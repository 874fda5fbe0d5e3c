"""Scenes that are made and not reported are counted from the workers' notes."""

import pytest

from schemas.dataset.commit import Span
from services.run.coordinator import count_under_way

SHARD = (Span(start=0, stop=4), Span(start=4, stop=8))


@pytest.mark.parametrize(
    ("in_progress", "made"),
    [
        ({}, 0),
        ({0: 0}, 0),
        ({0: 3}, 3),
        ({4: 4}, 4),
        ({4: 6}, 6),
        ({4: None}, 4),
        ({0: None, 4: 6}, 6),
        ({0: 99}, 0),
        ({8: 9}, 0),
    ],
)
def test_ranges_before_the_one_in_progress_and_scenes_before_the_one_in_progress_are_made(in_progress, made):
    assert count_under_way([SHARD], in_progress) == made


def test_shards_add_up_and_a_retry_counts_its_own_scenes():
    retry = (Span(start=16, stop=32, retry=1, scenes=(17, 20, 31)),)
    assert count_under_way([SHARD, retry], {4: 5, 16: 31}) == 5 + 2

"""Named streams of random numbers."""

import numpy as np

from workers.scene.plan import SceneChance, Stream


def test_a_stream_is_a_function_of_seed_scene_and_step():
    draw = SceneChance(5, 7).stream(Stream.CAMERA).random(4)
    assert np.array_equal(draw, SceneChance(5, 7).stream(Stream.CAMERA).random(4))
    others = ((6, 7, Stream.CAMERA), (5, 8, Stream.CAMERA), (5, 7, Stream.START))
    for seed, scene_id, name in others:
        assert not np.array_equal(draw, SceneChance(seed, scene_id).stream(name).random(4))


def test_the_first_object_has_the_stream_of_a_scene_with_one_object_and_each_further_one_its_own():
    chance = SceneChance(5, 7)
    alone = chance.stream(Stream.START).random()
    draws = [chance.object_stream(Stream.START, number).random() for number in range(4)]
    assert draws[0] == alone
    assert len(set(draws)) == 4


def test_stream_numbers_are_never_reused():
    """Append-only: renumbering a stream changes every dataset that was ever made."""
    assert {one.name: int(one) for one in Stream} == {
        "CATEGORY": 0, "OBJECT": 1, "TABLE": 2, "START": 3, "REDRAW": 4, "CAMERA": 5, "APPEARANCE": 6,
        "RAYCAST_CHECK": 7, "SENSOR_DEPTH": 8, "SENSOR_RGB": 9, "SENSOR_EXPOSURE": 10, "PATHS": 11, "COUNT": 12,
        "HIDDEN_MARKERS": 13, "MOTION": 14, "HELD_OUT": 15,
    }  # fmt: skip

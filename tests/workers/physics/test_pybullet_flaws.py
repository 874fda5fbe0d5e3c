"""Lists for PyBullet, new contents in the same objects; and standard error of compiled code, within the block and after it."""

import os

import numpy as np
import pytest

from workers.physics.bullet import STDERR, BulletBuffers, silence_stderr


def test_longer_and_shorter_lists_have_their_own_contents_in_the_same_objects():
    buffers, rng = BulletBuffers(), np.random.default_rng(0)
    seen = set()
    for count in (5, 2, 7, 7):
        points, values = rng.standard_normal((count, 3)), rng.integers(0, 300, count)
        vertices, indices = buffers.vertices(points), buffers.indices(values)
        assert np.array_equal(vertices, points)
        assert indices == values.tolist()
        seen |= {id(vertices), id(indices), *map(id, vertices)}
    assert len(seen) == 2 + 7


def test_an_index_is_the_same_object_each_time():
    """Python makes integers above 256 anew."""
    buffers = BulletBuffers()
    first = id(buffers.indices(np.array([100_000]))[0])
    assert id(buffers.indices(np.array([3, 100_000]))[1]) == first


def test_what_c_code_writes_is_dropped_within_the_block_alone(capfd):
    with silence_stderr():
        os.write(STDERR, b"banner")
    os.write(STDERR, b"message")
    assert capfd.readouterr().err == "message"


def test_standard_error_is_back_after_an_exception(capfd):
    with pytest.raises(ZeroDivisionError), silence_stderr():
        raise ZeroDivisionError
    os.write(STDERR, b"message")
    assert capfd.readouterr().err == "message"

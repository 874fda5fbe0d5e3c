"""Standard error of compiled code within the block and after it."""

import os

import pytest

from workers.physics.silence_stderr import STDERR, silence_stderr


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

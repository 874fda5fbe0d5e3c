"""Answers as bytes: what was written whole comes back."""

import pytest

from workers.assets.external.answers import read_answers, write_answer


@pytest.mark.parametrize("cut", [0, 1, 16, 17, 60])
def test_blocks_are_aligned_and_an_answer_that_was_not_finished_is_left_out(tmp_path, cut):
    path = tmp_path / "answers"
    with path.open("wb") as file:
        for _ in range(2):
            write_answer(file.fileno(), (b"-", [b"abc", memoryview(b"0123456789abcdefg")]))
    data = path.read_bytes()
    assert len(data) == 2 * (16 + 16 + 32)
    whole = b"abc".ljust(16, b"\0") + b"0123456789abcdefg".ljust(32, b"\0")
    found = [(kind, bytes(blocks)) for kind, blocks in read_answers(memoryview(data[: len(data) - cut]))]
    assert found == [(b"-", whole)] * (1 if cut else 2)

"""Answers of the process that reads files from outside, as bytes one after another."""

import os
from collections.abc import Iterator, Sequence

ALIGNMENT = 16
"""Bytes to which the blocks of an answer are aligned."""

Answer = tuple[bytes, Sequence[bytes | memoryview]]
"""One letter that says what kind of answer it is, and its blocks of bytes."""


def write_answer(sink: int, answer: Answer) -> None:
    """Appends an answer: its length and kind, and its blocks, each aligned to `ALIGNMENT`."""
    kind, blocks = answer
    lengths = [len(block) + -len(block) % ALIGNMENT for block in blocks]
    head = sum(lengths).to_bytes(8, "little") + kind.ljust(ALIGNMENT - 8)
    for block, length in ((head, ALIGNMENT), *zip(blocks, lengths, strict=True)):
        for data in (memoryview(block), memoryview(bytes(length - len(block)))):
            while data:
                data = data[os.write(sink, data) :]


def read_answers(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and blocks of each answer that `write_answer` wrote whole."""
    at = 0
    while at + ALIGNMENT <= len(data):
        start, stop = at + ALIGNMENT, at + ALIGNMENT + int.from_bytes(data[at : at + 8], "little")
        if stop <= len(data):
            yield bytes(data[at + 8 : start]).rstrip(), data[start:stop]
        at = stop

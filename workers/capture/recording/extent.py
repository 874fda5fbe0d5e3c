"""How long a Matroska file says that it is, read from its first bytes: what a cut file has lost follows from it.

Elements and their coding: RFC 8794 (EBML) and RFC 9559 (Matroska).
"""

import struct
from dataclasses import dataclass

HEAD_BYTES = 1 << 20
"""As many bytes from the start hold what comes before the first frame."""

_EBML, _SEGMENT, _INFO, _CLUSTER = 0x1A45DFA3, 0x18538067, 0x1549A966, 0x1F43B675
_SCALE, _DURATION = 0x2AD7B1, 0x4489


@dataclass(frozen=True)
class Extent:
    """The size of the whole file and the length of the recording, each None where the file does not say."""

    size_bytes: int | None = None
    duration_us: float | None = None


def read_extent(head: bytes) -> Extent:
    """Of a file that starts with `head`; all None for what is no Matroska file."""
    elements = list(_elements(head, 0, 2))
    if [identity for identity, _, _ in elements] != [_EBML, _SEGMENT]:
        return Extent()
    _, start, size = elements[1]
    whole = start + size if size else None  # a recorder that was interrupted has left 0 or `unknown`
    for identity, at, length in _elements(head, start):
        if identity == _CLUSTER:
            break
        if identity == _INFO and length is not None:
            return Extent(whole, _duration_us(head[: at + length], at))
    return Extent(whole)


def _duration_us(data: bytes, start: int) -> float | None:
    """Of the element Info whose content begins at `start` and ends with the data."""
    found = {identity: data[at : at + (length or 0)] for identity, at, length in _elements(data, start)}
    scale = int.from_bytes(found.get(_SCALE, b""), "big") or 1_000_000
    duration = found.get(_DURATION, b"")
    if len(duration) not in (4, 8):
        return None
    return float(struct.unpack(">f" if len(duration) == 4 else ">d", duration)[0]) * scale / 1000.0


def _elements(data: bytes, at: int, most: int = 10_000) -> list[tuple[int, int, int | None]]:
    """(identity, where its content begins, its length or None for unknown) of elements side by side from `at` on."""
    found: list[tuple[int, int, int | None]] = []
    while at + 2 <= len(data) and len(found) < most:
        width = 9 - data[at].bit_length()
        after = at + width
        if width > 4 or after >= len(data) or data[after] == 0:
            break
        wide = 9 - data[after].bit_length()
        coded = int.from_bytes(data[after : after + wide], "big") & ((1 << 7 * wide) - 1)
        length = None if coded == (1 << 7 * wide) - 1 else coded
        found.append((int.from_bytes(data[at:after], "big"), after + wide, length))
        if length is None:
            break
        at = after + wide + length
    return found

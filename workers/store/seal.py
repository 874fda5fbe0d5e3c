"""A seal: the SHA-256 of all bytes above it, in the last line of a text file. It reveals damage, not malice."""

import hashlib

_HEX = 64


def seal(text: str, before: str, after: str = "\n") -> bytes:
    """The text with a last line: the digest between `before` and `after`."""
    body = text.encode()
    return body + before.encode() + hashlib.sha256(body).hexdigest().encode() + after.encode()


def is_sealed(data: bytes, before: str, after: str = "\n") -> bool:
    """Whether a file is as it was sealed, to the byte."""
    line = len(before.encode()) + _HEX + len(after.encode())
    body = data[: max(len(data) - line, 0)]
    return data == body + before.encode() + hashlib.sha256(body).hexdigest().encode() + after.encode()

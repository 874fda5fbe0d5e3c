"""Edge: the one way to open bytes from outside: a regular file, a cap on its size, and any decoder's error as a refusal.

A refusal is made by a `Refuse`, from a short stable word and a sentence: `refuse_input` where a user gave the file on the
command line, the class MeshError or CaptureError where it is one item of many.
"""

import json
import os
import re
import stat
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from schemas.errors import InputError, VersoError, plain_line

Refuse = Callable[[str, str], VersoError]
"""The error of a reason (`missing`, `irregular`, `too_large`, `unreadable`) and a sentence that names the file."""

COPY_AGAIN = "copy it again, or make it anew"
"""The remedy for bytes that no decoder takes."""

LONGEST_NAME = 500
"""Letters of a file's name that a message shows."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
_ADDRESS = re.compile(r"\s*<[^<>]* at 0x[0-9a-fA-F]+>")


def refuse_input(reason: str, sentence: str) -> InputError:
    """A refusal of what a user named: the sentence alone."""
    return InputError(sentence)


def open_file(path: Path, refuse: Refuse = refuse_input) -> BinaryIO:
    """A regular file, or a link to one, for reading; anything else is refused, and nothing waits for a writer.

    Reasons: `missing` where it is not there, `irregular` for a folder, a pipe, a socket or a device, else `unreadable`.
    """
    name = plain_line(str(path), LONGEST_NAME)
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        if isinstance(error, OSError) and path.is_socket():
            raise refuse("irregular", f"{name} is a socket: give a file") from error
        reason = "missing" if isinstance(error, FileNotFoundError | NotADirectoryError) else "unreadable"
        remedy = "check its name" if reason == "missing" or isinstance(error, ValueError) else "check its permissions"
        raise refuse(reason, f"{name} cannot be read: {describe_error(error)}: {remedy}") from error
    mode = os.fstat(number).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(number, "rb")
    os.close(number)
    raise refuse("irregular", f"{name} is {_KINDS.get(stat.S_IFMT(mode), 'no file')}: give a file")


def read_bytes(path: Path, most_bytes: int, refuse: Refuse = refuse_input) -> bytes:
    """The bytes of a regular file of at most `most_bytes`; reasons as `open_file`, and `too_large` before it is read.

    A file that grows while it is read is refused as soon as it is over the cap.
    """
    with open_file(path, refuse) as stream, as_refusal(path, refuse):
        _check_size(path, os.fstat(stream.fileno()).st_size, most_bytes, refuse)
        parts, count = [], 0
        while data := stream.read(min(1 << 24, most_bytes + 1 - count)):
            parts.append(data)
            count += len(data)
            _check_size(path, count, most_bytes, refuse)
        return b"".join(parts)


def _check_size(path: Path, count: int, most_bytes: int, refuse: Refuse) -> None:
    if count > most_bytes:
        shown = plain_line(str(path), LONGEST_NAME)
        raise refuse("too_large", f"{shown} has over {most_bytes:,} bytes, and no more are read: make it smaller")


@contextmanager
def as_refusal(name: str | Path, refuse: Refuse = refuse_input, remedy: str = COPY_AGAIN) -> Iterator[None]:
    """Around the decoding of bytes from outside: whatever a library raises is the file's refusal, `unreadable`.

    What libraries raise for a stranger's bytes is no short list (zlib, lzma, struct, cv2, Arrow, YAML, ImportError for a codec
    that is not there ...), so every Exception is meant. The project's own errors pass as they are.
    """
    try:
        yield
    except VersoError:
        raise
    except Exception as error:
        shown = plain_line(str(name), LONGEST_NAME)
        remedy = "make it smaller" if isinstance(error, MemoryError) else remedy
        raise refuse("unreadable", f"{shown} cannot be read: {describe_error(error)}: {remedy}") from error


def describe_error(error: Exception) -> str:
    """Kind and message of an error in one line of at most 200 letters, without addresses in memory: refusals are stored."""
    if isinstance(error, MemoryError):
        return "it takes more memory than there is"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return plain_line(_ADDRESS.sub("", repr(error)), 200)


_MARKS = {
    b"\xef\xbb\xbf": "utf-8-sig",
    b"\xff\xfe\0\0": "utf-32",
    b"\0\0\xfe\xff": "utf-32",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
    b"<\0": "utf-16-le",
    b"\0<": "utf-16-be",
}
"""What a text begins with, and its encoding: byte order marks, and the first letter of XML without one (XML 1.0, appendix F)."""
_DECLARED = re.compile(rb"\s*<\?xml[^>]*?\sencoding\s*=\s*[\"']([\w.:-]+)")


def as_utf8(data: bytes) -> tuple[bytes, str | None]:
    """A text from outside as UTF-8 without a byte order mark, and what to note of it.

    By its mark, what its XML declaration says, as UTF-8, or else as Latin-1, which any bytes are: that alone is noted.
    """
    declared = _DECLARED.match(data)
    marks = [encoding for mark, encoding in _MARKS.items() if data.startswith(mark)]
    if not marks and declared is None and data.isascii():
        return data, None
    for encoding in (*marks[:1], *([declared[1].decode()] if declared else []), "utf-8"):
        with suppress(LookupError, UnicodeError):
            text = data.decode(encoding)
            if declared is None or text.startswith(declared[0].decode()):  # some declare UTF-16, and are not
                return text.encode(), None
    return data.decode("latin-1").encode(), "is not in UTF-8: read as Latin-1"


_HEADER = struct.Struct("<4sIII4s")
"""Magic, version and length of the file; length and kind of its first chunk."""


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON tree of a binary glTF file, and the bytes of its buffer, with up to 3 that fill it up.

    Raises struct.error or ValueError where it is none.
    """
    magic, version, _, length, kind = _HEADER.unpack_from(data)
    if magic == b"glTF" and version != 2:
        raise ValueError(f"binary glTF of version {version}: only 2 is read")
    if magic != b"glTF" or kind != b"JSON":
        raise ValueError("no glTF header")
    text = data[_HEADER.size : _HEADER.size + length]
    tree: dict[str, Any] = json.loads(text.rstrip(b"\0"))  # some exporters fill up with NUL
    return tree, data[_HEADER.size + length + 8 :]

"""A job file as one word that no shell changes: `job:` and letters, digits, `-` and `_`. Pure; the parser loads it."""

import base64
import binascii
import zlib
from typing import Final

from schemas.errors import JobError

MARK: Final = "job:"

MOST_CHARACTERS: Final = 100_000
"""Longest pack: Linux takes 131,072 bytes for one argument. A job file of ten sources packs into 2,000."""


def is_packed(name: str) -> bool:
    """Whether what is given for a job file is a packed one."""
    return name.startswith(MARK)


def pack(data: bytes) -> str:
    """The word for a job file's bytes. Raises JobError where it would be too long for a command line."""
    packed = MARK + base64.urlsafe_b64encode(zlib.compress(data, 9)).decode().rstrip("=")
    if len(packed) > MOST_CHARACTERS:
        raise JobError(
            f"packs into {len(packed)} characters, at most {MOST_CHARACTERS} fit on a command line: bring the file to the "
            "cluster (file_mounts) and give its path there"
        )
    return packed


def unpack(word: str, most_bytes: int) -> bytes:
    """The bytes that were packed, of which no more than `most_bytes` and one are unpacked. Raises JobError."""
    letters = word.removeprefix(MARK)
    try:
        packed = base64.b64decode(letters + "=" * (-len(letters) % 4), altchars=b"-_", validate=True)
        unpacking = zlib.decompressobj()
        data = unpacking.decompress(packed, most_bytes + 1)
    except (binascii.Error, zlib.error, ValueError) as error:
        raise JobError(f"was cut or changed on its way ({error}): pack it again with `verso pack JOB.yaml`") from error
    if len(data) <= most_bytes and not unpacking.eof:
        raise JobError("was cut on its way: pack it again with `verso pack JOB.yaml`")
    return data

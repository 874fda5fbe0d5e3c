"""The input files of a capture's folder, and their digest: what a dataset that is made of it depends on."""

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

from schemas.errors import CaptureError
from workers.store.capture_folder import BOARD_FILE, CAMERA_FILE, CAPTURE_FILE, TRUTH
from workers.store.capture_results import own_files

_IMAGE = re.compile(r"(?:rgb|depth|mask)_[0-9]{5,9}\.png|(?:board|correction)_[0-9]{5,9}\.txt")


def list_inputs(path: Path) -> list[Path]:
    """Every file that decides the result, sorted by name: descriptions, images, corrections, truth, a dictionary of markers.

    Results that processing wrote beside them are none of them. Raises CaptureError where process.json cannot be read.
    """
    ours = own_files(path)
    top = [file for file in path.iterdir() if file.is_file() and _is_input(file.name) and file.name not in ours]
    truth = [file for file in (path / TRUTH).rglob("*") if file.is_file()] if (path / TRUTH).is_dir() else []
    return sorted([*top, *truth, *_dictionary(path)])


def digest_inputs(path: Path) -> str:
    """64 hex characters: SHA-256 over the name and the SHA-256 of every input file. Raises CaptureError naming the folder."""
    total = hashlib.sha256(b"verso capture 1\n")
    try:
        for file in list_inputs(path):
            with open(file, "rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
            total.update(f"{file.relative_to(path).as_posix()}\n{content}\n".encode())
    except OSError as error:
        raise CaptureError(
            "unreadable", f"{error.filename or path} cannot be read: {error.strerror or error}"
        ) from error
    return total.hexdigest()


def _is_input(name: str) -> bool:
    return name in (CAMERA_FILE, BOARD_FILE, CAPTURE_FILE) or _IMAGE.fullmatch(name) is not None


def _dictionary(path: Path) -> Iterator[Path]:
    """The file of markers that board.json names, if it lies beside it."""
    try:
        found = re.search(rb'"dictionary"\s*:\s*"([^"/\\]+)"', (path / BOARD_FILE).read_bytes())
    except FileNotFoundError:
        return
    if found and (file := path / found[1].decode(errors="replace")).is_file() and not _is_input(file.name):
        yield file

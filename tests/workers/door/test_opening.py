"""Bytes from outside: regular files within a cap, and every decoder's error a refusal that names the file and the remedy."""

import json
import lzma
import os
import socket
import struct
import time
import zlib

import cv2
import numpy as np
import pyarrow as pa
import pytest
import yaml

from schemas.errors import CaptureError, InputError, JobError, MeshError
from workers.door.opening import COPY_AGAIN, as_refusal, open_file, read_bytes

CAP = 1000

SENTENCES = {
    "none": "none cannot be read: No such file or directory: check its name",
    "file/below": "below cannot be read: Not a directory: check its name",
    "a\0b": r"a\x00b cannot be read: ValueError('embedded null byte'): check its name",
    "folder": "folder is a folder: give a file",
    "pipe": "pipe is a pipe: give a file",
    "socket": "socket is a socket: give a file",
    "zero": "zero is a device: give a file",
    "loop": "loop cannot be read: Too many levels of symbolic links: check its permissions",
    "to_pipe": "to_pipe is a pipe: give a file",
    "large": "large has over 1,000 bytes, and no more are read: make it smaller",
    "endless": "endless has over 1,000 bytes, and no more are read: make it smaller",
    "odd\x1b[31m": r"odd\x1b[31m is a folder: give a file",
}
"""What is said of a path, by its name."""


@pytest.fixture
def places(tmp_path):
    for name, count in (("file", CAP), ("empty", 0), ("large", CAP + 1)):
        (tmp_path / name).write_bytes(b"x" * count)
    for name in ("folder", "odd\x1b[31m"):
        (tmp_path / name).mkdir()
    os.mkfifo(tmp_path / "pipe")
    links = {"zero": "/dev/zero", "loop": "loop", "to_pipe": "pipe", "link": "file", "endless": "/proc/self/maps"}
    for name, target in links.items():
        (tmp_path / name).symlink_to(target)
    here = os.getcwd()
    os.chdir(tmp_path)  # a socket's path may have 108 letters
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        os.chdir(here)
        yield tmp_path


@pytest.mark.parametrize("name", SENTENCES)
def test_what_is_no_regular_file_within_the_cap_is_refused_at_once(places, name):
    before, open_before = time.monotonic(), len(os.listdir("/proc/self/fd"))
    with pytest.raises(InputError) as refusal:
        read_bytes(places / name, CAP)
    assert time.monotonic() - before < 1.0 and len(os.listdir("/proc/self/fd")) == open_before
    assert str(refusal.value).startswith(str(places)) and str(refusal.value).endswith(SENTENCES[name])


def test_files_within_the_cap_are_read_whole_also_by_a_link(places):
    assert [len(read_bytes(places / name, CAP)) for name in ("file", "empty", "link")] == [CAP, 0, CAP]
    with open_file(places / "large") as stream:
        assert stream.read(4) == b"xxxx"


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log"
    path.write_bytes(b"x")
    stat = os.fstat
    monkeypatch.setattr(os, "fstat", lambda number: (stat(number), path.write_bytes(b"x" * (CAP + 1)))[0])
    with pytest.raises(InputError, match="over 1,000 bytes"):
        read_bytes(path, CAP)


def test_the_reason_goes_to_errors_that_have_one(places):
    reasons = {"none": "missing", "folder": "irregular", "large": "too_large", "loop": "unreadable"}
    for error in (MeshError, CaptureError):
        for name, reason in reasons.items():
            with pytest.raises(error) as refusal:
                read_bytes(places / name, CAP, error)
            assert refusal.value.reason == reason and refusal.value.detail.endswith(SENTENCES[name])


def _raises(error):
    raise error


DECODERS = {
    "utf-8": lambda: b"\xff".decode(),
    "nested json": lambda: json.loads("[" * 100_000),
    "struct": lambda: struct.unpack("<I", b"abc"),
    "zlib": lambda: zlib.decompress(b"abc"),
    "lzma": lambda: lzma.decompress(b"abc"),
    "cv2": lambda: cv2.imdecode(np.zeros(0, np.uint8), 0),
    "arrow": lambda: pa.ipc.open_file(b"abc"),
    "yaml": lambda: yaml.safe_load("{"),
    "assertion": lambda: _raises(AssertionError()),
    "no codec": lambda: _raises(ModuleNotFoundError("no module")),
}


@pytest.mark.parametrize("decoder", DECODERS)
def test_every_decoders_error_is_a_refusal_of_that_file(decoder):
    with pytest.raises(InputError) as refusal, as_refusal("a/b.x", remedy="export it again"):
        DECODERS[decoder]()
    told = str(refusal.value)
    assert told.startswith("a/b.x cannot be read: ") and told.endswith(": export it again")
    assert told.isprintable() and 40 < len(told) < 300 and refusal.value.__cause__ is not None


def test_a_refusal_says_what_is_wrong_and_no_address_in_memory():
    cases = {
        "it takes more memory than there is: make it smaller": MemoryError(),
        f"Input/output error: {COPY_AGAIN}": OSError(5, "Input/output error"),
        f"ValueError('bad value'): {COPY_AGAIN}": ValueError(f"bad{object()} value"),
        rf"ValueError('a\nb'): {COPY_AGAIN}": ValueError("a\nb"),
    }
    for what, error in cases.items():
        with pytest.raises(MeshError) as refusal, as_refusal("a.obj", MeshError):
            raise error
        assert refusal.value.reason == "unreadable"
        assert refusal.value.detail == f"a.obj cannot be read: {what}"


def test_our_own_errors_and_those_that_stop_the_program_pass():
    for error in (JobError("no"), MeshError("format", "no"), KeyboardInterrupt(), SystemExit(2)):
        with pytest.raises(type(error)) as passed, as_refusal("a"):
            raise error
        assert passed.value is error


def test_a_pipe_with_a_writer_is_refused_as_well(places):
    held = os.open(places / "pipe", os.O_RDWR)
    with pytest.raises(InputError, match="is a pipe"):
        read_bytes(places / "pipe", CAP)
    os.close(held)

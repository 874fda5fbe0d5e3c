"""The same pixels give the same PNG bytes, whatever was encoded before, wherever they lie, in every process."""

import os
import subprocess
import sys

import numpy as np
import pytest

from tests.encoded_digests import digests, main, render, save_sources


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    path = tmp_path_factory.mktemp("sources") / "sources.npy"
    save_sources(path, render(2))
    return path


@pytest.mark.parametrize(
    "images", [pytest.param(400, id="400"), pytest.param(100_000, id="100000", marks=pytest.mark.slow)]
)
@pytest.mark.timeout(3_600)
def test_two_processes_encode_alike_in_any_order_whatever_is_left_in_memory(sources, tmp_path, images):
    files = [tmp_path / "forward.npy", tmp_path / "backward.npy"]
    for file, more in zip(files, ([], ["--backward"]), strict=True):
        command = [sys.executable, "-m", "tests.encoded_digests", "digest", str(sources), str(file)]
        # glibc fills whatever is allocated or freed, in the second process alone.
        extra = {"MALLOC_PERTURB_": "165"} if more else {}
        subprocess.run([*command, "--images", str(images), *more], env={**os.environ, **extra}, check=True)
    assert len(np.load(files[0])) == images
    assert main(["compare", *map(str, files)]) == 0


def test_an_encoder_that_remembers_what_it_did_before_is_found(monkeypatch):
    counted = iter(range(10_000))

    def encode_and_count(pixels):
        return bytes([next(counted) % 256])

    monkeypatch.setattr("tests.encoded_digests.encode_png", encode_and_count)
    with pytest.raises(AssertionError, match="two encodings"):
        list(digests([np.zeros((4, 4), np.uint8)], range(10), seed=0))


def test_one_other_byte_is_told(tmp_path, capsys):
    files = [tmp_path / "one.npy", tmp_path / "two.npy"]
    one = np.zeros((5, 16), np.uint8)
    np.save(files[0], one)
    one[3, 7] = 1
    np.save(files[1], one)
    assert main(["compare", *map(str, files)]) == 1
    assert "5 images, 1 with other bytes: [3]" in capsys.readouterr().out

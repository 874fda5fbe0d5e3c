"""Job files as one word."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import JobError
from services.job.job_file import MARK, MOST_CHARACTERS, is_packed, load_job, pack, pack_job, unpack

HOSTILE = "verso: 1\nname: odd\nscenes: 4  # $(touch x); `touch y` | 'quote' \"quote\" && > < * ? ~ \\\n"


@given(st.binary(max_size=2000))
def test_what_is_packed_comes_back_from_a_word_that_no_shell_changes(data):
    word = pack(data)
    assert re.fullmatch(r"job:[A-Za-z0-9_-]*", word) and is_packed(word)
    assert unpack(word, 2000) == data


def test_a_packed_job_is_the_same_job(tmp_path):
    file = tmp_path / "odd.yaml"
    file.write_text(HOSTILE)
    word = pack_job(file)
    assert load_job(Path(word), ["scenes=9"]) == load_job(file, ["scenes=9"])


@pytest.mark.parametrize(
    "change", [lambda w: w[:-6], lambda w: w[:9] + "A" + w[10:], lambda w: w + "$", lambda w: MARK]
)
def test_a_word_that_was_cut_or_changed_is_told(change):
    with pytest.raises(JobError, match="pack it again"):
        unpack(change(pack(HOSTILE.encode())), 2000)


def test_a_small_word_cannot_become_a_large_file():
    bomb = pack(bytes(50_000_000))
    assert len(bomb) < 70_000
    assert len(unpack(bomb, 250_000)) == 250_001


def test_a_file_that_is_too_long_for_a_command_line_is_refused_with_the_way_out():
    random = np.random.default_rng(1).bytes(MOST_CHARACTERS)
    with pytest.raises(JobError, match="file_mounts"):
        pack(random)


def test_folders_of_a_packed_job_have_whole_paths(tmp_path):
    file = tmp_path / "meshes.yaml"
    file.write_text("name: meshes\nscenes: 2\ncategories: [mug]\nassets: {objects: [{source: urdf, folder: meshes}]}\n")
    with pytest.raises(JobError, match=r"assets\.objects\.0\.folder: 'meshes': a packed job has no folder of its own"):
        pack_job(file)
    file.write_text(file.read_text().replace("folder: meshes", "folder: /srv/meshes"))
    assert is_packed(pack_job(file))

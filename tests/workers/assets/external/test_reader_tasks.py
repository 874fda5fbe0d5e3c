"""What the reading process is asked, and that nothing but an answer or a refusal comes back."""

import json

import pytest

from schemas.job.assets import Assets, FolderSource, ShapeNetSource
from tests.workers.assets.oracles import CUBE, write
from workers.assets.external import reader_tasks
from workers.assets.external.listing import Entry, hash_files
from workers.assets.external.reader_tasks import (
    ANSWER,
    REFUSAL,
    Request,
    Task,
    answer_task,
    encode_request,
    open_request,
)

SETTINGS = FolderSource(source="urdf", folder=".")


@pytest.mark.parametrize("settings", [SETTINGS, ShapeNetSource(source="shapenet", folder="x", scale=2.0)])
def test_a_request_comes_back_as_it_was(tmp_path, settings):
    entry = Entry("id", hash_files([write(tmp_path / "a.obj", CUBE)], tmp_path), "MIT")
    tasks = (Task("list", tmp_path / "a.obj"), Task("load", tmp_path / "a.obj", "mug", entry))
    request = Request(settings, tmp_path, Assets(density_kg_m3=7.0, limits={"max_cpu_s": 3.0}), tasks)
    tree = json.loads(encode_request(request))
    assert (tree["memory_mb"], tree["cpu_s"]) == (2048, 3.0)
    assert open_request(tree) == request


def answer(folder, text, kind="check", name="a.obj", category="mug"):
    path = write(folder / name, text)
    entry = Entry("id", hash_files([path], folder), "MIT")
    letter, blocks = answer_task(Request(SETTINGS, folder, Assets(), (Task(kind, path, category, entry),)), 0)
    return letter + b"".join(blocks)


def test_a_file_is_listed_with_its_digest(tmp_path):
    ((name, size, sha256),) = json.loads(answer(tmp_path, CUBE, "list")[1:])
    assert (name, size, len(sha256)) == ("a.obj", len(CUBE), 64)


def test_a_good_mesh_passes_and_a_refused_one_says_why(tmp_path):
    assert answer(tmp_path, CUBE) == ANSWER
    refused = answer(tmp_path, "v 0 0 0\n")
    assert refused[:1] == REFUSAL
    assert json.loads(refused[1:]) == ["no_faces", f"{tmp_path}/a.obj has no triangles", "intrinsic"]


def test_a_single_triangle_is_no_body_but_may_be_a_table(tmp_path):
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    reason, detail, _ = json.loads(answer(tmp_path, triangle)[1:])
    assert reason == "no_hull" and "four points apart" in detail
    assert answer(tmp_path, triangle, category="table") == ANSWER


@pytest.mark.parametrize("error", [ValueError("a\nb\x00\ud800"), RecursionError(), AssertionError(), OSError(5, "I/O")])
def test_whatever_is_raised_is_a_refusal_in_one_line_that_names_the_file(tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(reader_tasks, "load_entry", fail)
    reason, detail, _ = json.loads(answer(tmp_path, CUBE)[1:])
    assert reason == "unreadable" and f"{tmp_path}/a.obj" in detail and detail.isprintable()


@pytest.mark.parametrize("error", [MemoryError(), OSError(12, "Cannot allocate memory")])
def test_memory_is_told_from_content(tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(reader_tasks, "load_entry", fail)
    with pytest.raises(MemoryError):
        answer(tmp_path, CUBE)


def test_a_urdf_names_what_is_seen_and_what_collides_below_the_folder(tmp_path):
    for name in ("seen.obj", "hit.obj"):
        write(tmp_path / "parts" / name, CUBE)
    mesh = '<geometry><mesh filename="{}"/></geometry>'.format
    text = f"<visual>{mesh('parts/seen.obj')}</visual><visual>{mesh('none.obj')}</visual>"
    text += f"<collision>{mesh('package://parts/hit.obj')}</collision>"
    urdf = f'<robot name="r"><link name="l">{text}</link></robot>'
    assert json.loads(answer(tmp_path, urdf, "names", "a.urdf")[1:]) == ["parts/seen.obj", "parts/hit.obj"]

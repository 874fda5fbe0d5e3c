"""The process that reads files from outside, as its worker sees it."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

from schemas.errors import MachineError, MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from tests.workers.assets.oracles import CUBE, textured_cube, write
from workers.assets.external import reader as module
from workers.assets.external.listing import Entry, hash_files
from workers.assets.external.reader import ROOT, Reader, ask_all, shared_reader
from workers.assets.external.reader_tasks import Request, Task

SETTINGS = FolderSource(source="urdf", folder=".")


def request(folder, *paths, kind="list", **limits):
    entries = [None if kind == "list" else Entry("a", hash_files([path], folder), "MIT") for path in paths]
    tasks = [Task(kind, path, "mug", entry) for path, entry in zip(paths, entries, strict=True)]
    return Request(SETTINGS, folder, Assets(limits=MeshLimits(**limits)), tuple(tasks))


def many_triangles(path, count):
    """An OBJ file that takes some seconds of processor time for each million triangles."""
    corners = "".join(f"v {k % 1000 / 1e3} {k // 1000 / 1e3} {k % 7 / 1e3}\n" for k in range(count + 2))
    return write(path, corners + "".join(f"f {k} {k + 1} {k + 2}\n" for k in range(1, count + 1)))


def test_processor_time_and_memory_are_verdicts_on_the_file_and_the_files_beside_it_are_read(tmp_path):
    good, slow = write(tmp_path / "good.obj", CUBE), many_triangles(tmp_path / "slow.obj", 1_400_000)
    limits = {"max_cpu_s": 1.0, "max_vertices": 2_000_000, "max_faces": 2_000_000}
    answers = list(shared_reader().ask(request(tmp_path, good, slow, good, kind="check", **limits)))
    assert [isinstance(answer, MeshError) for answer in answers] == [False, True, False]
    assert (answers[1].reason, answers[1].kind) == ("too_slow", "intrinsic")
    assert "slow.obj takes more than assets.limits.max_cpu_s = 1 s of processor time" in answers[1].detail


def test_textures_too_large_for_the_memory_refuse_their_mesh(tmp_path):
    mesh = textured_cube(tmp_path)
    Image.new("L", (9400, 9400)).save(tmp_path / "skin.png")
    limits = {"max_texture_px": 9400, "max_memory_mb": 1024}
    (answer,) = shared_reader().ask(request(tmp_path, mesh, kind="check", **limits))
    assert answer.reason == "too_large"
    assert "cube.obj takes more memory than assets.limits.max_memory_mb = 1024" in answer.detail


def test_a_server_that_has_ended_is_started_again(tmp_path):
    path = write(tmp_path / "a.obj", CUBE)
    reader = Reader()
    try:
        first = list(reader.ask(request(tmp_path, path)))
        reader._process.kill()
        reader._process.wait()
        assert list(reader.ask(request(tmp_path, path))) == first
    finally:
        reader.close()
        reader.close()


def test_a_server_that_cannot_start_is_the_machine_s_fault(tmp_path, monkeypatch):
    monkeypatch.setattr(module.sys, "executable", "/bin/false")
    reader = Reader()
    with pytest.raises(MachineError, match="ends at once"):
        list(reader.ask(request(tmp_path, write(tmp_path / "a.obj", CUBE))))


def test_a_child_that_is_killed_from_outside_is_no_verdict(tmp_path):
    reader = Reader()
    try:
        reader.last = module.Usage(0, 0.0, 0)
        asked = reader.ask(request(tmp_path, many_triangles(tmp_path / "slow.obj", 500_000), kind="check"))
        list(reader.ask(request(tmp_path, write(tmp_path / "a.obj", CUBE))))
        killer = subprocess.Popen([sys.executable, "-c", KILLER, str(reader._process.pid)])
        with pytest.raises(MachineError, match="killed from outside"):
            list(asked)
        assert killer.wait() == 0
    finally:
        reader.close()


KILLER = """
import os, sys, time
for _ in range(3000):
    children = open(f"/proc/{sys.argv[1]}/task/{sys.argv[1]}/children").read().split()
    if children:
        os.kill(int(children[0]), 9)
        break
    time.sleep(0.01)
"""


def test_a_server_ends_when_its_worker_is_killed(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from tests.workers.assets.external.test_reader import request, Reader;"
        "reader = Reader(); p = Path(sys.argv[1]); list(reader.ask(request(p.parent, p)));"
        "print(reader._process.pid, flush=True); time.sleep(60)"
    )
    path = write(tmp_path / "a.obj", CUBE)
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as worker:
        server = int(worker.stdout.readline())
        worker.send_signal(signal.SIGKILL)
    ends = time.monotonic() + 30
    while is_running(server):
        assert time.monotonic() < ends, "the server still runs"
        time.sleep(0.05)


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_many_files_are_answered_in_their_order_by_several_processes(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "WORTH_A_PROCESS", {"list": 4})
    monkeypatch.setattr(module, "BATCH", {"list": 3})
    paths = [write(tmp_path / f"{k}.obj", CUBE + "#" * k) for k in range(20)]
    told = []
    answers = list(ask_all(request(tmp_path, *paths), lambda *step: told.append(step)))
    assert [task.path for task, _ in answers] == paths
    assert len({bytes(answer) for _, answer in answers}) == 20
    assert told == [(done, 20) for done in (3, 6, 9, 12, 15, 18, 20)]

"""The limited processes that read files from outside: their limits, what comes back, and verdicts that are kept."""

import ctypes
import errno
import faulthandler
import json
import multiprocessing
import os
import pickle
import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from workers.assets.external import reader
from workers.assets.external import verdicts as verdict_file
from workers.assets.external.listing import Entry, SourceFile, hash_files
from workers.assets.external.placement import load_entry, read_measured
from workers.assets.external.reader import (
    Request,
    Task,
    answer_task,
    ask,
    ask_all,
    pack_asset,
    unpack_asset,
)
from workers.assets.external.verdicts import Verdicts, check_listing, load_asset_file, read_listing, verdict_key

from schemas.base import frozen_array
from schemas.errors import AssetSourceError, MachineError, MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from schemas.scene.shape import Asset, MassProperties, Material, Part, Shape
from tests.workers.door.oracles import CUBE, picture, textured_cube, write

SETTINGS = FolderSource(source="urdf", folder=".")
ROOT = Path(__file__).resolve().parents[3]


def request(folder, *paths, kind="list", category="mug", **limits):
    entries = [None if kind in ("list", "names") else Entry("a", hash_files([path], folder), "MIT") for path in paths]
    tasks = [Task(kind, path, category, entry) for path, entry in zip(paths, entries, strict=True)]
    return Request(SETTINGS, folder, Assets(limits=MeshLimits(**limits)), tuple(tasks))


def spin(seconds):
    begun = time.process_time()
    while time.process_time() < begun + seconds:
        pass
    return "list"


def crash():
    faulthandler.disable()
    ctypes.string_at(0)


def fail(number):
    raise OSError(number, "x")


def tell_limits():
    kinds = (resource.RLIMIT_AS, resource.RLIMIT_FSIZE, resource.RLIMIT_CORE)
    raise MeshError("told", f"a.obj {[resource.getrlimit(kind)[1] >> 20 for kind in kinds]}")


ACTS = {
    "fine": lambda: "list",
    "half": lambda: spin(0.6),
    "endless": lambda: spin(1e9),
    "crash": crash,
    "memory": lambda: bytes(8 << 30),
    "file": lambda: fail(errno.EFBIG),
    "exit": lambda: os._exit(3),
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "limits": tell_limits,
}


@dataclass(frozen=True)
class Act:
    """A task that does in the child what a stranger's file may make a parser do."""

    what: str
    path: Path
    category: str = ""
    entry: None = None

    @property
    def kind(self):
        """Does it."""
        return ACTS[self.what]()


def act(folder, *what, **limits):
    path = write(folder / "a.obj", CUBE)
    tasks = tuple(Act(one, path) for one in what)
    answers = ask(Request(SETTINGS, folder, Assets(limits=MeshLimits(**limits)), tasks))
    return [answer.reason if isinstance(answer, MeshError) else "read" for answer in answers]


def test_what_ends_a_child_is_a_verdict_on_its_file_alone_and_leaves_no_core(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for what, reason in (
        ("crash", "unreadable"),
        ("memory", "too_large"),
        ("file", "too_large"),
        ("exit", "unreadable"),
    ):
        assert act(tmp_path, "fine", what, "fine") == ["read", reason, "read"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.obj"]
    with pytest.raises(MachineError, match="killed from outside"):
        act(tmp_path, "fine", "killed")  # is no verdict
    assert act(tmp_path, "fine") == ["read"]


@pytest.mark.minute
def test_every_task_has_the_processor_time_for_itself_and_no_more(tmp_path):
    assert act(tmp_path, *["half"] * 3, "endless", "fine", max_cpu_s=1.0) == [*["read"] * 3, "too_slow", "read"]


def test_limits_are_hard_ones(tmp_path):
    path = write(tmp_path / "a.obj", CUBE)
    (told,) = ask(Request(SETTINGS, tmp_path, Assets(limits=MeshLimits(max_memory_mb=3000)), (Act("limits", path),)))
    assert told.detail == "a.obj [3000, 3000, 0]"


def test_an_answer_without_bounds_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(reader.Connection, "recv_bytes", _short(reader.Connection.recv_bytes))
    assert act(tmp_path, "fine") == ["unreadable"]


def _short(receive):
    return lambda self, most: receive(self, 10)


@pytest.mark.minute
def test_a_fork_server_that_has_ended_is_started_again_and_one_that_cannot_start_is_the_machine_s_fault(tmp_path):
    code = (
        "import os, signal, sys, time, multiprocessing.forkserver as f, multiprocessing.spawn as s\n"
        "from pathlib import Path; from tests.workers.assets.test_reader import *\n"
        "def kill(): os.kill(f._forkserver._forkserver_pid, signal.SIGKILL); time.sleep(1)\n"
        "folder = Path(sys.argv[1]); print(act(folder, 'fine')); kill(); print(act(folder, 'fine')); kill()\n"
        "s.set_executable('/bin/false')\n"
        "try: act(folder, 'fine')\n"
        "except MachineError as error: print(error)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    out = subprocess.run(command, capture_output=True, text=True, cwd=ROOT).stdout.splitlines()
    assert out[:2] == ["['read']"] * 2 and "ends at once" in out[2]


@pytest.mark.minute
def test_a_script_without_a_guard_is_not_run_again_and_its_reader_ends_with_it(tmp_path):
    script = write(
        tmp_path / "script.py",
        "import os, sys, time; from pathlib import Path; from tests.workers.assets.test_reader import *;"
        "print('once', act(Path(sys.argv[1]), 'fine'), flush=True);"
        "import multiprocessing.forkserver as f; print(f._forkserver._forkserver_pid, flush=True); time.sleep(60)",
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(script), str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=tmp_path, env=environment, text=True) as worker:
        assert worker.stdout.readline() == "once ['read']\n"
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


@pytest.mark.minute
def test_time_and_memory_are_verdicts_on_real_files_and_name_the_limit(tmp_path):
    count = 1_400_000  # several seconds of the fastest processor, where a limit of 1 s is kept to the next whole second
    corners = "".join(f"v {k % 1000 / 1e3} {k // 1000 / 1e3} {k % 7 / 1e3}\n" for k in range(count + 2))
    slow = write(tmp_path / "slow.obj", corners + "".join(f"f {k} {k + 1} {k + 2}\n" for k in range(1, count + 1)))
    (answer,) = ask(request(tmp_path, slow, kind="check", max_cpu_s=1.0))
    assert (answer.reason, answer.kind) == ("too_slow", "intrinsic")
    assert "slow.obj takes more than assets.limits.max_cpu_s = 1 s of processor time" in answer.detail
    Image.new("L", (9400, 9400)).save(tmp_path / "skin.png")
    mesh = textured_cube(tmp_path)
    (answer,) = ask(request(tmp_path, mesh, kind="check", max_texture_px=9400, max_memory_mb=1024))
    assert answer.reason == "too_large"
    assert "cube.obj takes more memory than assets.limits.max_memory_mb = 1024" in answer.detail


def test_many_files_are_answered_in_their_order_by_several_processes(tmp_path, monkeypatch):
    monkeypatch.setitem(reader.BATCH, "list", 3)
    paths = [write(tmp_path / f"{k}.obj", CUBE + "#" * k) for k in range(20)]
    told = []
    answers = list(ask_all(request(tmp_path, *paths), lambda *step: told.append(step)))
    assert [task.path for task, _ in answers] == paths
    assert len({answer for _, answer in answers}) == 20
    assert told == [(done, 20) for done in (3, 6, 9, 12, 15, 18, 20)]


def answer(folder, text, kind="check", name="a.obj", category="mug"):
    asked = request(folder, write(folder / name, text), kind=kind, category=category)
    return answer_task(asked, asked.tasks[0])


def test_whatever_is_raised_is_a_refusal_in_one_line_that_names_the_file_and_memory_is_told_apart(
    tmp_path, monkeypatch
):
    def load(*_):
        raise errors[0]

    monkeypatch.setattr(reader, "load_entry", load)
    for one in (ValueError("a\nb\x00\ud800"), RecursionError(), AssertionError(), OSError(5, "I/O")):
        errors = [one]
        reason, detail, _ = json.loads(answer(tmp_path, CUBE)[1:])
        assert reason == "unreadable" and f"{tmp_path}/a.obj" in detail and detail.isprintable()
    for one in (MemoryError(), OSError(12, "Cannot allocate memory")):
        errors = [one]
        with pytest.raises(MemoryError):
            answer(tmp_path, CUBE)


def test_pictures_are_counted_and_missing_ones_are_named(tmp_path):
    mesh = textured_cube(tmp_path).read_bytes()
    for count, notes in ((0, ("skin.png is missing: plain base colour used",)), (1, ())):
        found = read_measured(answer(tmp_path, mesh, "measure", "cube.obj")[1:])
        assert (found.textures, found.notes) == (count, notes)
        write(tmp_path / "skin.png", picture())


PICTURE = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
VERTICES = np.asfortranarray(np.random.default_rng(0).random((4, 3)))


def part(texture=None, **more):
    faces = frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)
    material = Material((0.1, 1 / 3, 0.3, 1.0), 0.2, 0.7, texture)
    return Part("a", frozen_array(VERTICES), faces, material, **more)


def asset():
    rich = part(PICTURE, normals=VERTICES, uv=frozen_array(np.zeros((4, 2))), colors=np.zeros((4, 4), np.uint8))
    mass = MassProperties(0.1 + 0.2, frozen_array([1 / 3, 0, 0]), frozen_array(np.eye(3) / 7), False)
    return Asset(
        "id", "mug", "urdf", "MIT", "a.obj", "e" * 64, Shape((rich, part(PICTURE), part()), True), mass,
        frozen_array(np.eye(4)), 1 / 3, False, None, True, ("a note",),
    )  # fmt: skip


def test_an_asset_comes_back_bit_by_bit_in_its_memory_order_with_its_shared_texture():
    sent = asset()
    back = unpack_asset(pack_asset(sent))
    assert (back.mass.mass_kg, back.scale, back.notes, back.shape.closed) == (0.1 + 0.2, 1 / 3, ("a note",), True)
    assert back.mass.inertia.tobytes() == sent.mass.inertia.tobytes()
    one, two, three = back.shape.parts
    assert one.vertices.tobytes("A") == sent.shape.parts[0].vertices.tobytes("A")
    assert one.vertices.strides == sent.shape.parts[0].vertices.strides == (8, 32)
    assert one.material.texture is two.material.texture and three.material.texture is None
    assert (one.material.texture == PICTURE).all() and one.material.base_color == (0.1, 1 / 3, 0.3, 1.0)
    assert (three.normals, three.uv, three.colors) == (None, None, None)
    assert not any(array.flags.writeable for array in (one.vertices, one.faces, one.normals, one.uv, one.colors))


def test_bytes_that_make_no_sense_are_refused():
    good = pack_asset(asset())
    size = int.from_bytes(good[:8], "little")

    def changed(**change):
        text = json.dumps(json.loads(good[8 : 8 + size]) | change).encode()
        return len(text).to_bytes(8, "little") + text + good[8 + size :]

    assert unpack_asset(changed()).instance_id == "id"
    arrays = good[8 + size :]
    huge = arrays.replace(b"(4, 3)", b"(9**9,)"), arrays.replace(b"(4, 3)", b"(1<<6,)")
    large = arrays.replace(b"'shape': (4, 3), }" + b" " * 11, b"'shape': (99999999999, 3), }" + b" ")
    pickled = arrays.replace(b"'<f8'", b"'|O' ")
    nan, face = asset(), asset()
    for values, bad in ((nan.shape.parts[0].vertices, np.nan), (face.shape.parts[0].faces, 9)):
        values.setflags(write=True)
        values[0, 0] = bad
    cases = [b"", bytes(64), good[:-20], changed(parts=[{"name": "a"}]), changed(arrays=2), changed(mass=[1.0])]
    cases += [good[: 8 + size] + one for one in (*huge, large, pickled)] + [pack_asset(nan), pack_asset(face)]
    for data in cases:
        with pytest.raises(MeshError, match="makes no sense"):
            unpack_asset(data)


# ------------------------------------------------------------------------------------------------ verdicts

ENTRY = Entry("a", (SourceFile("a.obj", 3, "e" * 64),), "MIT")
MIT = FolderSource(source="urdf", folder=".", licence="MIT")


def key(settings=SETTINGS, assets=None, category="mug", entry=ENTRY):
    return verdict_key(settings, assets or Assets(), category, entry)


def test_a_verdict_depends_on_files_settings_and_limits_and_not_on_folder_weight_or_licence():
    others = [
        key(settings=SETTINGS.model_copy(update={"scale": 2.0})),
        key(assets=Assets(limits={"max_faces": 7})),
        key(category="table"),
        key(entry=Entry("a", (SourceFile("a.obj", 3, "f" * 64),), "MIT")),
    ]
    assert len({key(), *others}) == 5
    assert key(settings=SETTINGS.model_copy(update={"folder": "y", "weight": 2.0, "licence": "MIT"})) == key()
    assert key(category="can") == key()


def test_what_was_found_out_is_read_again_and_names_the_folder_that_it_is_asked_for(tmp_path):
    (tmp_path / "file").write_text("no folder")
    kept = Verdicts(tmp_path / "kept")
    kept.put([("a", None), ("b", MeshError("no_faces", "/one/b.obj has no triangles")), ("c", "y")], "/one")
    for verdicts in (kept, Verdicts(tmp_path / "kept")):
        assert "a" in verdicts and "d" not in verdicts
        assert (verdicts.get("a", "/two"), verdicts.get("c", "/two")) == (None, "y")
        assert verdicts.get("b", "/two").detail == "/two/b.obj has no triangles"
    for folder in (None, tmp_path / "file" / "verdicts"):  # that cannot be written
        verdicts = Verdicts(folder)
        verdicts.put([("a", None)], "/one")
        assert "a" in verdicts


def test_a_torn_line_or_a_flipped_bit_is_found_out_again_and_the_next_line_is_whole(tmp_path):
    for cut in range(1, 60, 7):
        folder = tmp_path / str(cut)
        Verdicts(folder).put([("a", None), ("b", MeshError("no_faces", "none"))], "/one")
        (path,) = folder.iterdir()
        whole = path.read_bytes()
        path.write_bytes(whole.replace(b"none", b"nOne"))
        assert "b" not in Verdicts(folder)
        path.write_bytes(whole[:-cut])
        torn = Verdicts(folder)
        assert "b" not in torn or cut == 1
        torn.put([("c", None)], "/one")
        assert "c" in Verdicts(folder)


def _put(folder, name):
    verdicts = Verdicts(folder)
    for number in range(50):
        verdicts.put([(f"{name}{number}", None)], "/one")


@pytest.mark.minute
def test_processes_that_write_at_once_lose_nothing(tmp_path):
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.starmap(_put, [(tmp_path, "a"), (tmp_path, "b")])
    verdicts = Verdicts(tmp_path)
    assert all(f"{name}{number}" in verdicts for name in "ab" for number in range(50))


def listed(folder, *names):
    return read_listing(MIT, folder, {"mug": [folder / name for name in names]}, MeshLimits())


def test_refused_candidates_are_counted_by_reason_and_others_keep_their_order(tmp_path):
    for name in ("c.obj", "d.obj", "b.obj"):
        write(tmp_path / name, CUBE)
    candidates = {"mug": [tmp_path / name for name in ("none.obj", "d.obj", "b.obj")], "can": [tmp_path / "a.fbx"]}
    listing = read_listing(MIT, tmp_path, candidates, MeshLimits())
    found = {name: [entry.files[0].path for entry in entries] for name, entries in listing.entries.items()}
    assert found == {"mug": ["d.obj", "b.obj"], "can": []}
    assert list(listing.skipped.items()) == [("format", 1), ("missing", 1)]
    assert listing.examples[0].startswith("none.obj (missing: cannot be read")


def test_what_cannot_be_used_is_marked_and_what_was_found_out_is_not_found_out_again(tmp_path, monkeypatch):
    path = write(tmp_path / "a.obj", CUBE)
    write(tmp_path / "b.obj", "v 0 0 0\n")
    listing, verdicts = listed(tmp_path, "a.obj", "b.obj"), Verdicts(tmp_path / "kept")
    checked = check_listing(MIT, listing, Assets(), verdicts)
    assert (checked.refused, checked.skipped) == ({"mug": frozenset({1})}, {"no_faces": 1})
    assert checked.examples == ("b.obj (no_faces: has no triangles)",)
    with monkeypatch.context() as patch:
        patch.setattr(
            verdict_file,
            "ask_all",
            lambda request, watch: iter([]) if not request.tasks else pytest.fail("asked again"),
        )
        for kept in (verdicts, Verdicts(tmp_path / "kept")):
            assert check_listing(MIT, listing, Assets(), kept) == checked
    write(path, CUBE + "#")
    with pytest.raises(AssetSourceError, match="has changed"):
        check_listing(MIT, listing, Assets(), Verdicts(None))
    with pytest.raises(MeshError, match="changed") as error:
        load_asset_file(MIT, tmp_path, listing.entries["mug"][0], "mug", Assets())
    path.unlink()
    with pytest.raises(MeshError, match="missing") as missing:
        load_asset_file(MIT, tmp_path, listing.entries["mug"][0], "mug", Assets())
    # Neither is a function of job and seed, and it stays so on the way to another process.
    assert {pickle.loads(pickle.dumps(one.value)).kind for one in (error, missing)} == {"environmental"}


def test_an_asset_read_by_another_process_is_the_one_that_is_read_here_and_holds_no_open_file(tmp_path):
    textured_cube(tmp_path)
    write(tmp_path / "skin.png", picture(colour=None))
    (entry,) = listed(tmp_path, "cube.obj").entries["mug"]
    files = len(list(Path("/proc/self/fd").iterdir()))
    there = [load_asset_file(MIT, tmp_path, entry, "mug", Assets()) for _ in range(2)][1]
    assert len(list(Path("/proc/self/fd").iterdir())) == files
    here = load_entry(MIT, tmp_path, entry, "mug", Assets())
    assert (there.instance_id, there.notes, there.scale) == (here.instance_id, here.notes, here.scale)
    assert there.mass.inertia.tobytes() == here.mass.inertia.tobytes()
    for one, two in zip(there.shape.parts, here.shape.parts, strict=True):
        assert one.vertices.tobytes() == two.vertices.tobytes()
        assert one.vertices.strides == two.vertices.strides and not one.vertices.flags.writeable
        assert (one.faces == two.faces).all() and one.faces.dtype == two.faces.dtype
        assert (one.material.texture == two.material.texture).all()

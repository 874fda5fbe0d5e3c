"""What a process sees of its node, asked of real processes and folders."""

import json
import os
import subprocess
import sys
from pathlib import Path

from ray import cloudpickle

from services.run import worker_entry
from services.run.worker_entry import Sight, look_at_folder, processor_flags, see, start_environment
from workers.shard.code import code_digest

ROOT = Path(__file__).resolve().parents[3]


def lock_in(folder: Path, token: str) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "_lock.json").write_text(json.dumps({"token": token, "beat": 7}))
    return str(folder / "_lock.json")


def test_processor_flags_are_those_of_the_first_core(tmp_path):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nflags\t\t: fpu avx2 bmi2\n\nflags\t\t: other\n")
    assert processor_flags(cpuinfo) == {"fpu", "avx2", "bmi2"}
    cpuinfo.write_text("Features\t: asimd\n")
    assert processor_flags(cpuinfo) == frozenset()
    assert processor_flags(tmp_path / "absent") == frozenset()


def test_what_a_process_sets_later_is_not_what_it_was_started_with():
    look = "import os; os.environ['ONE'] = 'changed'; from services.run.worker_entry import start_environment as s; print(s"
    command = [sys.executable, "-c", f"{look}(['ONE', 'TWO', 'THREE']))"]
    environ = {"PYTHONPATH": str(ROOT), "ONE": "first", "TWO": "a=b"}
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str({"ONE": "first", "TWO": "a=b"})
    assert start_environment(["no such variable"]) == {}


def test_it_loads_nothing_that_reads_the_environment():
    look = "import sys, services.run.worker_entry; print(*{'numpy', 'pydantic', 'cv2', 'ray', 'OpenGL'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", look], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_folder_is_the_drivers_if_its_file_holds_the_token(tmp_path):
    proof = lock_in(tmp_path / "out", "ours")
    assert look_at_folder(proof, "ours", 0) == ""
    assert [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()] == ["_lock.json"]
    assert look_at_folder(proof, "theirs", 0) == "it holds the lock of another run"
    assert look_at_folder(str(tmp_path / "absent" / "_lock.json"), "ours", 0) == "there is no such folder"
    (tmp_path / "empty").mkdir()
    assert look_at_folder(str(tmp_path / "empty" / "_lock.json"), "ours", 0) == "it is another folder"


def test_a_token_that_arrives_late_is_waited_for(tmp_path):
    """As on a network file system, or while the heartbeat is being written."""
    later = (
        f"import time; time.sleep(0.4); open({str(tmp_path / '_lock.json')!r}, 'w').write('{{\"token\": \"ours\"}}')"
    )
    (tmp_path / "_lock.json").write_text("{")
    with subprocess.Popen([sys.executable, "-c", later]):
        assert look_at_folder(str(tmp_path / "_lock.json"), "ours", 10) == ""


def test_a_folder_that_can_only_be_read_is_told(tmp_path, monkeypatch):
    proof = lock_in(tmp_path / "out", "ours")

    def refuse(*_: object) -> int:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "open", refuse)
    assert look_at_folder(proof, "ours", 0) == "it cannot be written (Read-only file system)"


def test_a_node_tells_its_code_or_why_it_has_none(tmp_path):
    assert see((), "", "").code == code_digest()
    cloudpickle.register_pickle_by_value(worker_entry)
    try:
        question = cloudpickle.dumps(lambda: see((), "", "").no_code)
    finally:
        cloudpickle.unregister_pickle_by_value(worker_entry)
    away = f"import sys; sys.path = [p for p in sys.path if p != {str(ROOT)!r}]; from ray import cloudpickle"
    answer = f"{away}; print(cloudpickle.loads(sys.stdin.buffer.read())())"
    done = subprocess.run(
        [sys.executable, "-P", "-c", answer], cwd=tmp_path, input=question, capture_output=True, check=False
    )
    assert done.stdout.decode().strip() == "No module named 'workers'", done.stderr


def test_a_sight_is_plain_data():
    seen = see(("PATH",), "", "")
    assert Sight(**seen.__dict__) == seen
    assert seen.environment == {"PATH": os.environ["PATH"]} or "PATH" in seen.environment

import os
import signal
import subprocess
import sys
import tempfile

from workers.store.file_system import remove_abandoned, temporary_folder

HOLD = """
import sys, time
from workers.store.file_system import temporary_folder
with temporary_folder("test") as folder:
    (folder / "rows").write_bytes(b"12")
    print(folder, flush=True)
    time.sleep(600)
"""


def test_a_folder_is_kept_while_its_process_lives_and_goes_after_it_was_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    command = [sys.executable, "-c", HOLD]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": str(tmp_path)}
    ) as holder:
        folder = holder.stdout.readline().strip()
        remove_abandoned("test")
        assert os.listdir(folder) == ["rows"]
        holder.send_signal(signal.SIGKILL)
    assert os.path.isdir(folder)
    with temporary_folder("test") as mine:
        assert not os.path.isdir(folder)
        assert os.listdir(mine) == []
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_just_being_made_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    young, old = tmp_path / "verso-test-a", tmp_path / "verso-test-b"
    for folder in (young, old):
        folder.mkdir()
    os.utime(old, (0, 0))
    remove_abandoned("test")
    assert young.is_dir()
    assert not old.exists()

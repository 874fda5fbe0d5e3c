"""Output folders that cannot be used: one line that says which folder, why, and what to do."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.layout import JOB_FILE
from schemas.errors import OutputError
from services.cli.main import main
from services.job.job_file import validate_job
from services.job.record import encode_job, record_job, refuse_foreign
from services.run.lock import read_holder
from workers.store.attempt import begin_attempt
from workers.store.local import LocalStore

ROOT = Path(__file__).resolve().parents[3]
TABLETOP = str(ROOT / "deploy" / "jobs" / "tabletop.yaml")


def run_without_privileges(out: Path) -> subprocess.CompletedProcess[str]:
    """A run of this user; root without the right to write where nobody may."""
    command = [sys.executable, "-m", "services.cli.main", "run", TABLETOP, "--scenes", "1", "--out", str(out)]
    if os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", *command]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("prepared", [False, True])
def test_a_folder_that_this_user_may_not_write_is_told_with_the_user(tmp_path, prepared):
    out = tmp_path / "out"
    LocalStore(out).prepare() if prepared else out.mkdir()
    for folder in [out, *out.rglob("*")]:
        folder.chmod(0o555)
    done = run_without_privileges(out)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"verso: {out} cannot be written: permission denied for user ")
    assert f"({os.geteuid()})" in line
    assert "file system" not in line


@pytest.mark.root
def test_a_file_system_that_is_mounted_read_only_is_told_as_that(tmp_path):
    run = f"{sys.executable} -m services.cli.main run {TABLETOP} --out {tmp_path}"
    command = f"mount -t tmpfs -o ro none {tmp_path} && exec {run}"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line == f"verso: {tmp_path} cannot be written: the file system is mounted read-only; or choose another --out"


@pytest.mark.parametrize("name", ["thesis.tex", ".hidden", "RGB00000.png"])
def test_a_folder_with_somebodys_files_is_refused_not_filled(tmp_path, capsys, name):
    (tmp_path / name).write_text("mine")
    assert main(["run", TABLETOP, "--scenes", "1", "--out", str(tmp_path)]) == 2
    assert f"{tmp_path} holds {name}, and no job.yaml" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_an_earlier_start_or_a_new_file_system_left_is_nobodys(tmp_path):
    (tmp_path / "lost+found").mkdir()
    (tmp_path / "_lock.json").write_text("{}")
    LocalStore(tmp_path).prepare()
    refuse_foreign(LocalStore(tmp_path))
    (tmp_path / "more").write_text("")
    with pytest.raises(OutputError, match="more"):
        refuse_foreign(LocalStore(tmp_path))


HOLD = """
import sys, time
from services.run.lock import hold_lock
from workers.store.local import LocalStore
with hold_lock(LocalStore(sys.argv[1])):
    print(flush=True)
    time.sleep(600)
"""


def test_status_tells_a_run_that_was_killed_from_one_that_runs(tmp_path, capsys):
    store, job = LocalStore(tmp_path), validate_job({"name": "small", "scenes": 8}, "test")
    store.prepare()
    store.put(JOB_FILE, encode_job(record_job(job, "c" * 64, Path())))
    begin_attempt(
        store, Span(start=0, stop=8), CommitTerms(job_digest="j" * 64, fingerprint="f" * 64, pairs_per_scene=1)
    ).begin_scene(3)
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE)
    assert holder.stdout is not None
    try:
        holder.stdout.readline()
        assert main(["status", str(tmp_path)]) == 1
        told = capsys.readouterr().out
        assert "  running: range from 0, scene 3" in told
        assert "gone" not in told
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        assert main(["status", str(tmp_path)]) == 1
        told = capsys.readouterr().out
        assert "  was running: range from 0, scene 3" in told
        assert f"held by process {holder.pid} on " in told
        assert ", which is gone: start the run again" in told
        assert "  running" not in told
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
    assert read_holder(store) is not None

"""The commands as typed: exit codes, what they print for people and, in the last line, for programs, and refusals in one line."""

import argparse
import errno
import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.layout import JOB_FILE
from schemas.environment import KEEP, STACK_ENVIRONMENT
from services.cli import doctor
from services.cli.commands import default_page
from services.cli.doctor import Finding
from services.cli.environment import as_typed
from services.cli.main import main
from services.job.job_file import validate_job
from services.job.record import encode_job, record_job
from services.run.lock import read_holder
from tests.datasets import make_dataset
from tests.kit.killed_runs import holding
from workers.render.raster import context
from workers.render.raster.context import GraphicsDevice
from workers.store.attempt import begin_attempt
from workers.store.local import LocalStore

ROOT = Path(__file__).resolve().parents[3]
TABLETOP = str(ROOT / "deploy" / "jobs" / "tabletop.yaml")


def ended(capsys, *arguments: str) -> tuple[int, str, str]:
    """Exit code, and what was written to standard output and to standard error."""
    try:
        code = main(list(arguments))
    except SystemExit as exit_:  # argparse's own
        code = int(exit_.code or 0)
    captured = capsys.readouterr()
    assert "Traceback" not in captured.out + captured.err
    return code, captured.out, captured.err


def told(capsys, *arguments: str) -> tuple[int, str]:
    """Exit code and everything that was written."""
    code, out, err = ended(capsys, *arguments)
    return code, out + err


def answer(capsys, *arguments: str) -> tuple[int, list[str], dict]:
    """Exit code, the lines for people, and the last line parsed."""
    code = main([*arguments, "--json"])
    *lines, last = capsys.readouterr().out.splitlines()
    return code, lines, json.loads(last)


def verso(*arguments: str, cwd: Path = ROOT, **more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", "services.cli.main", *arguments]
    environ = {**os.environ, "PYTHONPATH": str(ROOT), **more}
    return subprocess.run(command, cwd=cwd, env=environ, capture_output=True, text=True, check=False, timeout=120)


# ------------------------------------------------------------------------------------------------ how it is called


def test_commands_are_printed_as_they_are_typed_here(tmp_path, monkeypatch):
    (tmp_path / "verso").write_text("#!/bin/sh\n")
    (tmp_path / "verso").chmod(0o755)
    text = "run `verso status OUT`, verso verify x; /opt/verso run, verso: no, my-verso run, verso COMMAND"
    for path, typed, called in (
        ("/nowhere", "./verso", "./verso"),
        ("/nowhere", "", "verso"),
        ("/nowhere", "docker compose run --rm job", "docker compose run --rm job"),
        (str(tmp_path), str(tmp_path / "verso"), "verso"),  # the shell finds it
        ("/nowhere", str(tmp_path / "verso"), str(tmp_path / "verso")),
    ):
        monkeypatch.setenv("VERSO_TYPED", typed)
        monkeypatch.setenv("PATH", path)
        printed = (
            f"run `{called} status OUT`, {called} verify x; /opt/verso run, verso: no, my-verso run, {called} COMMAND"
        )
        assert as_typed(text) == printed
    monkeypatch.undo()
    done = verso("logs", "j0a1b2c3d", "--queue", str(tmp_path / "none"), VERSO_TYPED="./verso")
    assert done.returncode == 2 and "`./verso submit` or `./verso supervise` makes a new queue" in done.stderr
    printed = verso("run", "--help", VERSO_TYPED="./verso").stdout
    assert printed.startswith("usage: ./verso run") and "example: ./verso run deploy" in printed


# ------------------------------------------------------------------------------------------------ what is refused

REFUSED = (
    (["run", "nowhere.yaml"], ["nowhere.yaml", "no such file", "deploy/jobs"]),
    (["run", TABLETOP, "--set", "physcs.step_hz=3"], ["physcs", "did you mean 'physics'"]),
    (["run", TABLETOP, "--set", "categories=[sofa]"], ["categories.sofa", "laptop, mug, bowl"]),
    (["run", TABLETOP, "--set", "assets.objects.0={source: library, folder: /nowhere/at/all}"], ["/nowhere/at/all"]),
    (["run", TABLETOP, "--set", "assets.objects.0={source: library, folder: .}"], ["deploy/jobs has no mesh"]),
    (["run", TABLETOP, "--address", "nonsense"], ["HOST:PORT"]),
    (["replay", "nowhere", "x"], ["'x'"]),
    (["status", str(ROOT)], ["job.yaml"]),
    (["extra", "study"], ["pip install 'verso-data[study]'"]),
    (["lock"], ["type ./verso lock there"]),
)


def test_bad_input_is_told_by_key_value_and_remedy(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for arguments, words in REFUSED:
        out = ["--out", str(tmp_path / "out")] if arguments[0] == "run" else []
        code, text = told(capsys, *arguments, *out)
        assert code == 2 and all(word in text for word in words), text
        assert list(tmp_path.iterdir()) == []
    assert answer(capsys, "run", "nowhere.yaml")[2]["kind"] == "JobError"


@pytest.mark.parametrize(
    ("error", "told"),
    [(OSError(errno.ENOSPC, "", "x"), "x: the disk is full"), (KeyboardInterrupt(), "interrupted; ")],
    ids=["a full disk", "an interrupt"],
)
def test_what_ends_a_command_from_outside_is_an_answer_too(error, told, monkeypatch, capsys):
    monkeypatch.setattr("services.cli.queue_commands.open_queue", Mock(side_effect=error))
    code, lines, found = answer(capsys, "jobs", "--queue", "anywhere")
    assert (code, lines, found["ok"]) == (1, [], False)
    assert found["error"].startswith(told)


READERS = "status *|verify *|query * 'select 1'|replay * 3|report *|export * new --format bop|score * .|score . *"
READERS += "|init * --out new|score . --compare * *|capture process *|capture synthesize * --mirror|capture evaluate *"


def test_a_missing_folder_is_told_alike_by_all_that_read_one_and_nothing_is_written(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my data").mkdir()
    for words in map(shlex.split, READERS.split("|")):
        code, text = told(capsys, *("my dta" if word == "*" else word for word in words))
        assert (code, text) == (2, "verso: my dta: there is no such folder; did you mean 'my data'?\n"), words
    assert [path.name for path in tmp_path.iterdir()] == ["my data"]
    code, text = told(capsys, "status", "my data")
    assert code == 2 and "holds no job.yaml" in text


def test_a_reader_says_that_it_cannot_check_before_it_reads_anything(made, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "services.read.audit", None)  # as where verso-read is installed
    monkeypatch.setattr("services.read.verify.verify", lambda *_: pytest.fail("everything was read first"))
    code, text = told(capsys, "verify", made.name, "--independent", "2")
    assert code == 1 and "verify --independent or --audit needs what makes data" in text


def test_a_remedy_can_be_pasted_into_a_shell(made, capsys, tmp_path):
    shutil.copytree(made.name, tmp_path / "my data")
    victim = next((tmp_path / "my data").glob("manifest/scenes/*/*.parquet"))
    victim.write_bytes(victim.read_bytes()[:-40])
    _, text = told(capsys, "query", str(tmp_path / "my data"), "select * from scenes")
    assert f"`verso verify '{tmp_path}/my data'` lists every damaged file" in text
    _, text = told(capsys, "replay", str(tmp_path / "my data"), "99")
    assert shlex.split(text.partition("`")[2].partition("`")[0]) == ["verso", "status", f"{tmp_path}/my data"]


def test_a_folder_without_a_usable_mesh_is_refused_with_what_is_in_it(capsys, tmp_path):
    (tmp_path / "broken.obj").write_text("f 1 2 3\n")
    source = f"assets.objects.0={{source: library, folder: {tmp_path}}}"
    asked = ["run", TABLETOP, "--set", source, "--set", "categories=[broken]", "--out", str(tmp_path / "out")]
    code, text = told(capsys, *asked)
    assert code == 2 and f"none of 1 meshes for 'broken' in {tmp_path} can be used: broken.obj (index_out" in text
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------------ output folders


def run_without_privileges(out: Path) -> subprocess.CompletedProcess[str]:
    """A run of this user; root without the right to write where nobody may."""
    command = [sys.executable, "-m", "services.cli.main", "run", TABLETOP, "--scenes", "1", "--out", str(out)]
    if os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", *command]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("prepared", [pytest.param(False, marks=pytest.mark.minute), True])
def test_a_folder_that_this_user_may_not_write_is_told_with_the_user(tmp_path, prepared):
    out = tmp_path / "out"
    LocalStore(out).prepare() if prepared else out.mkdir()
    for folder in [out, *out.rglob("*")]:
        folder.chmod(0o555)
    done = run_without_privileges(out)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"verso: {out} cannot be written: permission denied for user ")
    assert f"({os.geteuid()})" in line and "file system" not in line


@pytest.mark.root
def test_a_file_system_that_is_mounted_read_only_is_told_as_that(tmp_path):
    run = f"{sys.executable} -m services.cli.main run {TABLETOP} --out {tmp_path}"
    command = ["unshare", "-m", "sh", "-c", f"mount -t tmpfs -o ro none {tmp_path} && exec {run}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)
    (line,) = done.stderr.splitlines()
    assert line == f"verso: {tmp_path} cannot be written: the file system is mounted read-only; or choose another --out"
    assert done.returncode == 2


def test_status_tells_a_run_that_was_killed_from_one_that_runs(tmp_path, capsys):
    store, job = LocalStore(tmp_path), validate_job({"name": "small", "scenes": 8}, "test")
    store.prepare()
    store.put(JOB_FILE, encode_job(record_job(job, "c" * 64, Path())))
    terms = CommitTerms(job_digest="j" * 64, fingerprint="f" * 64, pairs_per_scene=1)
    begin_attempt(store, Span(start=0, stop=8), terms).begin_scene(3)
    with holding(tmp_path) as holder:
        alive = told(capsys, "status", str(tmp_path))
    dead = told(capsys, "status", str(tmp_path))
    assert alive[0] == dead[0] == 1
    assert "  running: range from 0, scene 3" in alive[1] and "gone" not in alive[1]
    assert "  was running: range from 0, scene 3" in dead[1] and "  running" not in dead[1]
    assert f"held by process {holder.pid} on " in dead[1] and ", which is gone: start the run again" in dead[1]
    assert read_holder(store) is not None


# ------------------------------------------------------------------------------------------------ of a dataset


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> LocalStore:
    return make_dataset(tmp_path_factory.mktemp("made") / "small", categories=["box"])[0]


def test_what_the_commands_say_of_a_finished_dataset(made, capsys):
    code, lines, tree = answer(capsys, "status", made.name)
    assert (code, tree["ok"], tree["made"], tree["missing"]) == (0, True, 2, 0)
    assert lines[0] == f"{made.name}: 2 of 2 scenes done, 0 missing" and lines[-1] == f"  digest: {tree['digest']}"
    code, lines, tree = answer(capsys, "verify", made.name, "--independent", "1")
    assert (code, tree["ok"], tree["scenes"], tree["pairs"]) == (0, True, 2, 2)
    assert (tree["independent"]["scenes"], tree["independent"]["faults"]) == (1, [])
    assert "2 scenes, labels of 2 pairs derived again: nothing off" in lines[0]
    assert lines[1].startswith("labels of 1 pair of 1 scene derived from the article's definitions, and ")
    assert "their rest from contact forces: nothing off" in lines[1]
    rows = told(capsys, "query", made.name, "select scene_id from scenes order by 1", "--format", "csv")[1]
    assert rows.split() == ["scene_id", "0", "1"]
    assert answer(capsys, "replay", made.name, "1")[2]["differences"] == []
    tree = answer(capsys, "report", made.name, "--scenes", "1")[2]
    page = Path(f"{made.name}-report.html")
    assert (tree["file"], tree["bytes"]) == (str(page), page.stat().st_size) and default_page(f"{made.name}/") == page
    assert (tree["scenes"], len(tree["shown"])) == (2, 1)
    assert str(default_page("s3://bucket/sets/small")) == "small-report.html"


# ------------------------------------------------------------------------------------------------ the machine


@pytest.mark.minute
def test_a_machine_without_gl_is_told_what_to_install():
    done = verso("doctor", __EGL_VENDOR_LIBRARY_DIRS="/nowhere")
    assert done.returncode == 1 and "no off-screen OpenGL" in done.stdout
    assert "apt-get install -y libgl1 libegl1 libgl1-mesa-dri" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


def test_a_missing_part_is_told_with_its_remedy_and_exits_1(monkeypatch, capsys):
    for name in ("_ray", "_gpus", "_stack"):
        monkeypatch.setattr(doctor, name, lambda name=name: Finding(name, True, "there"))
    monkeypatch.setattr(doctor, "examine_machine", lambda: [Finding(name, True, "there") for name in "abcde"])
    for suffices, code in ((True, 0), (False, 1)):
        monkeypatch.setattr(doctor, "_renderer", lambda ok=suffices: Finding("GL", ok, "found", "install it"))
        assert doctor.main(argparse.Namespace(json=True)) == code
        *lines, last = capsys.readouterr().out.splitlines()
        assert any("install it" in line for line in lines) is not suffices
        assert json.loads(last)["ok"] is suffices and len(json.loads(last)["findings"]) == 9


def test_every_gpu_is_listed_with_its_device_and_the_one_that_would_be_drawn_on(monkeypatch):
    gpus = tuple(GraphicsDevice(1 - number, f"card{number}", True, number) for number in range(2))
    software = GraphicsDevice(2, "Mesa's software")
    for listed, visible, words in (
        ((*gpus, software), None, "drawn on device 0 (the first)"),
        ((*gpus, software), "0", "drawn on device 1 (CUDA_VISIBLE_DEVICES is '0')"),
        ((*gpus, software), "9", "drawn on device 2 (CUDA_VISIBLE_DEVICES is '9', and EGL has"),
        (gpus, "9", "none that may be drawn on"),
        ((), "0", "EGL lists none"),
    ):
        monkeypatch.setattr(context, "list_devices", lambda listed=listed: listed)
        monkeypatch.setattr(context, "visible_gpus", lambda visible=visible: visible)
        finding = doctor._gpus()
        assert words in finding.found and finding.ok == (words != "none that may be drawn on"), finding
        if software in listed:
            assert "EGL device 1 (card0, CUDA 0); EGL device 0 (card1, CUDA 1); EGL device 2 (Mesa's" in finding.found
        if not finding.ok:
            assert "NVIDIA_DRIVER_CAPABILITIES=all" in finding.remedy


PRINT_ENVIRONMENT = """
import json, os, sys
from services.cli.environment import enter_stack_environment
enter_stack_environment()
print(json.dumps([dict(os.environ), sys.argv, hash("verso"), sys.flags.safe_path]))
"""


def test_a_command_starts_itself_again_in_the_stacks_environment_unless_asked_not_to(tmp_path):
    (tmp_path / "script.py").write_text(PRINT_ENVIRONMENT)

    def start(*args: str, **environ: str) -> list:
        command = [sys.executable, "-P", str(tmp_path / "script.py"), *args]
        bare = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), **environ}
        return json.loads(subprocess.run(command, env=bare, capture_output=True, text=True, check=True).stdout)

    environ, argv, first, safe_path = start("a b", "--c=*", OMP_NUM_THREADS="64", OTHER="kept", PYTHONHASHSEED="random")
    assert {name: environ[name] for name in STACK_ENVIRONMENT} == dict(STACK_ENVIRONMENT)
    assert (environ["OTHER"], argv[1:], safe_path) == ("kept", ["a b", "--c=*"], True)
    assert start(PYTHONHASHSEED="1")[2] == first
    environ, *_ = start(OMP_NUM_THREADS="64", **{KEEP: "1"})
    assert environ["OMP_NUM_THREADS"] == "64" and "PYGLET_HEADLESS" not in environ

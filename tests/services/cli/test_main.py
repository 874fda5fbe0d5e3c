"""The command line: exit codes, one clear message, no traceback, nothing half-written."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.cli.main import main

ROOT = Path(__file__).resolve().parents[3]
TABLETOP = str(ROOT / "deploy" / "jobs" / "tabletop.yaml")


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code and everything that was written."""
    try:
        code = main(list(arguments))
    except SystemExit as exit_:  # argparse's own
        code = int(exit_.code or 0)
    captured = capsys.readouterr()
    assert "Traceback" not in captured.out + captured.err
    return code, captured.out + captured.err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run", "nowhere.yaml"], 2, ["nowhere.yaml", "no such file", "deploy/jobs"]),
        (["run", TABLETOP, "--set", "physcs.step_hz=3"], 2, ["physcs", "did you mean 'physics'"]),
        (["run", TABLETOP, "--set", "physics.step_hz=fast"], 2, ["physics.step_hz", "'fast'", "whole number"]),
        (["run", TABLETOP, "--scenes", "-3"], 2, ["--scenes", "-3"]),
        (["run", TABLETOP, "--set", "scenes=0"], 2, ["scenes", "0", "at least 1"]),
        (
            ["run", TABLETOP, "--set", "cameras.orbit.radius_m=-1"],
            2,
            ["cameras.orbit.radius_m", "-1", "greater than 0"],
        ),
        (["run", TABLETOP, "--set", "start.offset_m=[0.2, 0.1]"], 2, ["start.offset_m", "empty"]),
        (["run", TABLETOP, "--set", "categories=[sofa]"], 2, ["categories.sofa", "laptop, mug, bowl"]),
        (
            ["run", TABLETOP, "--set", "assets.objects.0={source: urdf, folder: /nowhere/at/all}"],
            2,
            ["/nowhere/at/all"],
        ),
        (
            ["run", TABLETOP, "--set", "assets.objects.0={source: shapenet, folder: .}"],
            2,
            ["deploy/jobs", "synset folders"],
        ),
        (["run"], 2, ["JOB.yaml"]),
        (["fly"], 2, ["fly", "run"]),
        (["query", "nowhere", "select 1"], 2, ["nowhere", "job.yaml"]),
        (["verify", "nowhere"], 2, ["nowhere", "job.yaml"]),
        (["replay", "nowhere", "x"], 2, ["'x'"]),
        (["status", str(ROOT)], 2, ["job.yaml"]),
    ],
)
def test_bad_input_is_told_by_key_value_and_remedy(capsys, tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    out = ["--out", str(tmp_path / "out")] if arguments[:1] == ["run"] and len(arguments) > 1 else []
    found, text = told(capsys, *arguments, *out)
    assert found == code, text
    assert all(word in text for word in words), text
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_usable_mesh_is_refused_with_what_was_found(capsys, tmp_path):
    assets = tmp_path / "assets"
    assets.mkdir()
    (assets / "broken.obj").write_text("f 1 2 3\n")
    source = f"assets.objects.0={{source: urdf, folder: {assets}, category_map: {{'*.obj': mug}}}}"
    code, text = told(
        capsys, "run", TABLETOP, "--set", source, "--set", "categories=[mug]", "--out", str(tmp_path / "out")
    )
    assert code == 2
    assert str(assets) in text or "broken" in text
    assert not (tmp_path / "out").exists()


def test_an_output_that_cannot_be_written_is_refused(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    code, text = told(capsys, "run", TABLETOP, "--out", str(tmp_path / "file" / "out"))
    assert code in (1, 2)
    assert "file/out" in text


def test_a_ray_that_does_not_answer_is_told_at_once(capsys, tmp_path):
    code, text = told(capsys, "run", TABLETOP, "--address", "127.0.0.1:1", "--out", str(tmp_path / "out"))
    assert code == 1
    assert "127.0.0.1:1" in text
    assert "ray start" in text
    code, text = told(capsys, "run", TABLETOP, "--address", "nonsense", "--out", str(tmp_path / "out"))
    assert code == 2
    assert "HOST:PORT" in text


def test_a_dry_run_says_what_would_be_done_and_does_nothing(capsys, tmp_path):
    code, text = told(capsys, "run", TABLETOP, "--dry-run", "--scenes", "5", "--out", str(tmp_path / "out"))
    assert code == 0
    assert "scenes 0 to 4" in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["run", "status", "verify", "replay", "query", "doctor", "test"])
def test_every_command_explains_itself_with_an_example(capsys, command):
    code, text = told(capsys, command, "--help")
    assert code == 0
    assert "xample" in text or command == "test"


def test_an_error_can_be_read_by_a_program(capsys):
    assert main(["run", "nowhere.yaml", "--json"]) == 2
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["kind"] == "JobError"


def test_a_machine_without_gl_is_told_what_to_install():
    environment = {**os.environ, "__EGL_VENDOR_LIBRARY_DIRS": "/nowhere"}
    done = subprocess.run(
        [sys.executable, "-m", "services.cli.main", "doctor"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "no off-screen OpenGL" in done.stdout
    assert "apt-get install -y libgl1 libegl1 libgl1-mesa-dri" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.ray
@pytest.mark.minute
def test_the_first_command_of_the_readme_makes_a_dataset_and_the_others_read_it(tmp_path):
    """From the shell, as a user would, with a small job."""
    out = tmp_path / "out"

    def verso(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-P", "-m", "services.cli.main", *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )

    (tmp_path / "services").mkdir()  # a folder of the user's that has one of our generic names
    (tmp_path / "services" / "__init__.py").write_text("raise RuntimeError('somebody else')")
    made = verso("run", TABLETOP, "--out", "out", "--scenes", "3", "--json")
    assert made.returncode == 0, made.stderr
    answer = json.loads(made.stdout.splitlines()[-1])
    assert answer["scenes"] == {"made": 3, "intrinsic": 0, "environmental": 0}
    assert "pybullet build time" not in made.stdout + made.stderr
    assert len((out / "camPoses.csv").read_text().splitlines()) == 1 + 6
    status = verso("status", "out", "--json")
    assert (status.returncode, json.loads(status.stdout.splitlines()[-1])["missing"]) == (0, 0)
    assert "nothing off" in verso("verify", "out").stdout
    assert "none differ" in verso("replay", "out", "1").stdout
    rows = verso("query", "out", "select scene_id from scenes order by 1", "--format", "csv").stdout.split()
    assert rows == ["scene_id", "0", "1", "2"]
    assert verso("export", "out", "two", "--format", "gltf", "--scenes", "2").returncode == 0
    (scene,) = (tmp_path / "two").rglob("*.glb")
    assert scene.read_bytes()[:4] == b"glTF"
    again = verso("run", TABLETOP, "--out", "out", "--scenes", "3", "--json")
    assert json.loads(again.stdout.splitlines()[-1])["digest"] == answer["digest"]
    other = verso("run", TABLETOP, "--out", "out", "--scenes", "3", "--set", "seed=1")
    assert other.returncode == 2
    assert "seed: 2024 there, 1 here" in other.stderr

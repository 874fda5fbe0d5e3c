"""Docker and compose as the tests of deploy/ use them: an image built once, a checkout of another user, a digest to reach."""

import fcntl
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NOT_COPIED = shutil.ignore_patterns(".git", ".venv*", "data", ".*_cache", "__pycache__", "*.egg-info")

IMAGE = "verso-under-test"

SCENES = 16
"""Enough for two of each category: the shapes of boxes and cans are what other instruction sets change first."""

JOB = "deploy/jobs/tabletop.yaml"

Done = subprocess.CompletedProcess[str]


def run(*command: str, cwd: Path | None = None, **environ: str) -> Done:
    """The command's result, whatever it is."""
    return subprocess.run(
        command, cwd=cwd, env={**os.environ, **environ}, capture_output=True, text=True, check=False, timeout=900
    )


def docker(*args: str) -> Done:
    return run("docker", *args)


def must(done: Done) -> str:
    """The standard output of a command that has to succeed."""
    assert done.returncode == 0, f"{done.args}: {done.returncode}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@dataclass(frozen=True)
class Compose:
    """`docker compose` in a checkout, as a project of its own."""

    checkout: Path
    project: str

    def __call__(self, *args: str, **environ: str) -> Done:
        return run("docker", "compose", *args, cwd=self.checkout, **self.environ, **environ)

    @property
    def environ(self) -> dict[str, str]:
        return {"VERSO_IMAGE": IMAGE, "COMPOSE_PROJECT_NAME": self.project}

    def container(self, service: str, number: int = 1) -> str:
        return f"{self.project}_{service}_{number}"


def owner_of_checkouts() -> int:
    """User id of the checkouts' owner: not root where the test can change owners, and no user of the image."""
    return 1234 if os.geteuid() == 0 else os.geteuid()


def copy_checkout(folder: Path) -> Path:
    """A copy of this checkout that belongs to the owner of checkouts."""
    shutil.copytree(ROOT, folder, ignore=NOT_COPIED)
    if os.geteuid() == 0:
        owner = owner_of_checkouts()
        subprocess.run(["chown", "-R", f"{owner}:{owner}", str(folder)], check=True)
    return folder


def build_image(folder: Path) -> str:
    """The image of this checkout, built from a copy in `folder`."""
    compose = Compose(copy_checkout(folder), IMAGE)
    must(compose("build"))
    return IMAGE


def local_digest(folder: Path, scenes: int = SCENES) -> str:
    """The digest of the job on this machine: what every other way to run it has to reach."""
    args = ("run", JOB, "--scenes", str(scenes), "--out", str(folder / "local"), "--json")
    answer = must(run(sys.executable, "-m", "services.cli.main", *args, cwd=ROOT, PYTHONPATH=str(ROOT)))
    return digest_in(answer)


def digest_in(answer: str) -> str:
    """The digest in the answer of `verso run --json`, which may have other lines before and after it."""
    (line,) = (line for line in answer.splitlines() if '"digest"' in line)
    return str(json.loads(line[line.index("{") :])["digest"])


def digest_of(out: Path) -> str:
    """The digest of a finished dataset."""
    return str(json.loads((out / "_SUCCESS").read_text())["digest"])


def once(shared: Path, name: str, make: Callable[[Path], str]) -> str:
    """What `make` returns, made by the first of several test processes and read by the others."""
    with open(shared / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        kept = shared / f"{name}.txt"
        if not kept.exists():
            folder = shared / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            kept.write_text(make(folder))
        return kept.read_text()


def wait_for(condition: Callable[[], bool], seconds: float, what: str, every_s: float = 0.3) -> float:
    """Seconds until the condition held, looked at again after `every_s`; fails after `seconds`."""
    begun = time.monotonic()
    while not condition():
        assert time.monotonic() - begun < seconds, f"{what}: not within {seconds:.0f} s"
        time.sleep(every_s)
    return time.monotonic() - begun

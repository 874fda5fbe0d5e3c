"""The container image, the compose file and a first start on a bare Debian, run with Docker."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOT_COPIED = shutil.ignore_patterns(".git", ".venv*", "data", ".*_cache", "__pycache__", "*.egg-info")
PYTHON_IMAGE = "python:3.11-slim-bookworm"
DEBIAN_IMAGE = "debian:bookworm-slim"

pytestmark = [pytest.mark.docker, pytest.mark.timeout(1500)]


def docker(*args: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environ = {**os.environ, "VERSO_IMAGE": "verso-under-test", "COMPOSE_PROJECT_NAME": "verso-under-test"}
    return subprocess.run(["docker", *args], cwd=cwd, env=environ, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def owner() -> int:
    """User id of the checkout's owner: not root where the test can change owners, and no user of the image."""
    return 1234 if os.geteuid() == 0 else os.geteuid()


@pytest.fixture(scope="module")
def checkout(tmp_path_factory, owner) -> Path:
    folder = tmp_path_factory.mktemp("image") / "checkout"
    shutil.copytree(ROOT, folder, ignore=NOT_COPIED)
    if os.geteuid() == 0:
        subprocess.run(["chown", "-R", f"{owner}:{owner}", str(folder)], check=True)
    return folder


@pytest.fixture(scope="module")
def image(checkout) -> str:
    built = docker("compose", "build", cwd=checkout)
    assert built.returncode == 0, built.stdout[-2000:] + built.stderr[-2000:]
    return "verso-under-test"


def test_the_image_runs_verso_and_not_as_root(image):
    version = docker("run", "--rm", image, "--version")
    assert version.returncode == 0, version.stderr
    assert "0.1.0" in version.stdout
    assert docker("run", "--rm", "--entrypoint", "id", image, "-u").stdout.strip() == "1000"


def test_the_image_carries_neither_tests_nor_history(image):
    listing = docker("run", "--rm", "--entrypoint", "ls", image, "-A", "/opt/verso").stdout.split()
    assert {"schemas", "services", "workers"} <= set(listing)
    assert not {".git", ".venv", "data", "tests"} & set(listing)


def test_compose_makes_a_dataset_that_belongs_to_the_checkouts_owner(image, checkout, owner):
    job = ("run", "deploy/jobs/tabletop.yaml", "--scenes", "2", "--out", "/data/tabletop")
    done = docker("compose", "run", "--rm", "job", *job, cwd=checkout)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    made = [checkout / "data", *(checkout / "data").rglob("*")]
    assert checkout / "data" / "tabletop" / "_SUCCESS" in made
    assert {file.stat().st_uid for file in made} == {owner}


def test_without_python_it_stops_with_both_ways_on(checkout):
    done = docker("run", "--rm", "-v", f"{checkout}:/repo", DEBIAN_IMAGE, "/repo/verso", "--version")
    assert done.returncode == 1
    assert "apt-get install python3.11" in done.stderr
    assert "docker compose up" in done.stderr


@pytest.mark.slow
def test_a_bare_debian_with_python_311_needs_nothing_else(checkout):
    twice = "/repo/verso --version && /repo/verso --version"
    done = docker("run", "--rm", "-v", f"{checkout}:/repo", PYTHON_IMAGE, "bash", "-c", twice)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [done.stdout.splitlines()[0]] * 2
    assert done.stderr.count("first start") == 1

"""Blocks of pages run as typed where verso-read or verso-data is installed, from the wheels, outside of any checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from deploy.wheels import OURS
from tests.datasets import make_dataset
from tests.deploy.test_wheels import HEAVY
from tests.docs.test_pages import READERS, ROOT, blocks
from tests.services.export.conftest import SHAPED, with_samples

PACKAGES = {"reader": ("verso_read", "verso.services"), "data": ("verso_data", "services")}
"""By installation the wheel, and the package of the command line."""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheels")
    subprocess.run([sys.executable, "-P", "deploy/wheels.py", str(folder)], cwd=ROOT, check=True)
    return folder


@pytest.fixture
def environment(wheels, request, tmp_path) -> dict[str, str]:
    """The variables of a shell in which an installation's `python` and `verso` are the first ones on the path."""
    (wheel, services), site, programs = PACKAGES[request.param], tmp_path / "site", tmp_path / "bin"
    with zipfile.ZipFile(next(wheels.glob(f"{wheel}-*.whl"))) as packed:
        packed.extractall(site)
    missing = [*sorted(HEAVY), *OURS] if request.param == "reader" else []
    (site / "sitecustomize.py").write_text(f"import sys\nsys.modules.update(dict.fromkeys({missing}))\n")
    programs.mkdir()
    start = f"import sys; from {services}.cli.main import main; sys.exit(main())"
    for name, words in {"python": sys.executable, "verso": f"{sys.executable} -P -c '{start}'"}.items():
        (programs / name).write_text(f'#!/bin/sh\nexec {words} "$@"\n')
        (programs / name).chmod(0o755)
    return {
        **os.environ,
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PYTHONPATH": str(site),
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(tmp_path / "hf"),
    }


def type_all(page: str, installation: str, folder: Path, environment: dict[str, str]) -> int:
    """Runs each block for the installation, Python's in one process; their number."""
    mine = [(language, text) for language, where, text in blocks(page) if where == installation and language]
    sessions = [text for language, text in mine if language == "sh"]
    python = "\n".join(text for language, text in mine if language == "python")
    for command in (*(["bash", "-ec", text] for text in sessions), ["python", "-W", "ignore", "-c", python]):
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=300
        )
        assert done.returncode == 0, f"{page}\n{command[-1]}\n{done.stderr[-2000:]}"
    return len(mine)


@pytest.mark.minute
@pytest.mark.timeout(600)
@pytest.mark.parametrize("environment", ["reader"], indirect=True)
@pytest.mark.parametrize("page", READERS)
def test_a_page_for_readers_runs_where_nothing_can_make_data(page, environment, tmp_path):
    make_dataset(tmp_path / "data/tabletop", scenes=6, categories=["mug", "can"])
    if page == "docs/export.md":
        with_samples(make_dataset(tmp_path / "data/targets", **SHAPED)[0])
    assert type_all(page, "reader", tmp_path, environment) >= 4


@pytest.mark.minute
@pytest.mark.timeout(600)
@pytest.mark.parametrize("environment", ["data"], indirect=True)
def test_what_needs_what_makes_data_runs_without_a_checkout(environment, tmp_path):
    assert type_all("docs/reading.md", "data", tmp_path, environment) == 1

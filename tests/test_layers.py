"""The layer rules in pyproject.toml, each broken once on purpose: a rule that never bites protects nothing."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SIBLINGS = ("assets", "capture", "geometry", "render", "scene", "store")


def lint(project: Path, imports: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Check a skeleton of the three packages in which these files import these modules."""
    shutil.copy(ROOT / "pyproject.toml", project)
    for package in ("schemas", "services", "workers", *(f"workers/{name}" for name in SIBLINGS)):
        (project / package).mkdir()
        (project / package / "__init__.py").touch()
        (project / package / "thing.py").touch()
    for file, module in imports.items():
        (project / file).write_text(f"import {module}\n")
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    return subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("file", "module", "rule"),
    [
        ("schemas/job.py", "workers.thing", "never back"),
        ("workers/shard.py", "services.thing", "never back"),
        ("workers/scene/plan.py", "workers.assets.thing", "do not know one another"),
        ("workers/assets/simulate.py", "workers.render.thing", "do not know one another"),
        ("schemas/scene.py", "trimesh", "schemas load nothing heavy"),
        ("workers/shard.py", "ray", "workers never import Ray"),
        ("services/cli.py", "ray", "Ray is known"),
        ("workers/scene/check.py", "pybullet", "PyBullet is imported in one file"),
        ("services/bench.py", "pybullet", "PyBullet is imported in one file"),
        ("workers/store/images.py", "OpenGL.GL", "OpenGL stays in its room"),
        ("services/report.py", "pyrender", "OpenGL stays in its room"),
    ],
)
def test_a_forbidden_import_is_found(tmp_path, file, module, rule):
    done = lint(tmp_path, {file: module})
    assert done.returncode == 1, done.stdout + done.stderr
    broken = [line for line in done.stdout.splitlines() if line.endswith("BROKEN")]
    assert len(broken) >= 1
    assert any(rule in line for line in broken)


def test_what_the_rules_allow_passes(tmp_path):
    allowed = {
        "services/coordinator.py": "ray",
        "services/jobs.py": "ray.job_submission",
        "services/cli.py": "services.coordinator",
        "workers/scene/bullet.py": "pybullet",
        "workers/render/gbuffer.py": "OpenGL.GL",
        "workers/scene/views.py": "workers.geometry.thing",
        "workers/store/paths.py": "schemas.thing",
        "workers/shard.py": "workers.scene.settle, workers.render.gbuffer, workers.store.paths",
    }
    done = lint(tmp_path, allowed)
    assert done.returncode == 0, done.stdout + done.stderr

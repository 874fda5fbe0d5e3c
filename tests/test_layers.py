"""The layer rules in pyproject.toml, each broken once on purpose: a rule that never bites protects nothing."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    *("schemas", "schemas/dataset", "schemas/job", "schemas/scene"),
    "services",
    *(
        f"services/{name}"
        for name in (
            *("bench", "cli", "dataset", "export", "init", "job", "look", "merge", "queue"),
            *("read", "read/independent", "run", "study"),
        )
    ),
    "workers",
    *(
        f"workers/{name}"
        for name in (
            *("assets", "capture", "geometry", "physics", "render", "render/raster", "scene", "shard", "store"),
            "capture/surface",
        )
    ),
)
FILES = (
    *("schemas/base.py", "schemas/capture.py", "schemas/environment.py", "schemas/errors.py", "schemas/queue.py"),
    *("services/capture.py", "services/read/dataset_reader.py", "services/read/verify.py"),
)


def lint(project: Path, imports: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Check a skeleton of the three packages in which these files import these modules."""
    shutil.copy(ROOT / "pyproject.toml", project)
    for package in PACKAGES:
        (project / package).mkdir()
        (project / package / "__init__.py").touch()
        (project / package / "thing.py").touch()
    for file in FILES:
        (project / file).touch()
    for file, module in imports.items():
        (project / file).write_text(f"import {module}\n")
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    return subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("file", "module", "rule"),
    [
        ("schemas/job/job.py", "workers.thing", "never back"),
        ("workers/shard/run_shard.py", "services.thing", "never back"),
        ("schemas/job/job.py", "schemas.scene.thing", "schemas: what is stored"),
        ("workers/render/tiers.py", "workers.scene.thing", "stages apart"),
        ("workers/assets/mass.py", "workers.physics.thing", "stages apart"),
        ("workers/geometry/hull.py", "workers.physics.thing", "stages apart"),
        ("workers/scene/plan.py", "workers.shard.thing", "stages apart"),
        ("workers/geometry/hull.py", "subprocess", "geometry is pure"),
        ("services/merge/merge.py", "services.run.thing", "services: commands"),
        ("services/read/query.py", "services.dataset.thing", "services: commands"),
        ("services/read/independent/derive.py", "workers.geometry.thing", "the independent derivation"),
        ("services/read/independent/derive.py", "schemas.dataset.thing", "the independent derivation"),
        ("services/read/independent/poses.py", "services.read.verify", "the independent derivation"),
        ("schemas/scene/scene.py", "trimesh", "schemas load nothing heavy"),
        ("workers/shard/run_shard.py", "ray", "workers never import Ray"),
        ("services/cli/main.py", "ray", "Ray is known"),
        ("workers/scene/ray_check.py", "pybullet", "PyBullet is imported in one file"),
        ("services/bench/measure.py", "pybullet", "PyBullet is imported in one file"),
        ("workers/store/images.py", "OpenGL.GL", "OpenGL stays in its room"),
        ("services/look/report.py", "pyrender", "OpenGL stays in its room"),
        ("workers/render/tiers.py", "mitsuba", "Mitsuba stays in one file"),
        ("workers/capture/surface/fusion.py", "skimage.measure", "each known to one file"),
        ("services/capture.py", "reportlab.pdfgen", "each known to one file"),
        ("schemas/capture.py", "schemas.dataset.thing", "schemas: what is stored"),
        ("services/run/run_job.py", "prometheus_client", "Prometheus is known to one file"),
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
        "services/run/coordinator.py": "ray",
        "services/cli/main.py": "services.run.coordinator",
        "workers/physics/bullet.py": "pybullet",
        "workers/render/raster/gbuffer.py": "OpenGL.GL",
        "workers/scene/pairs.py": "workers.geometry.thing",
        "workers/store/local.py": "schemas.dataset.thing",
        "workers/scene/plan.py": "workers.physics.thing, workers.assets.thing",
        "workers/shard/run_shard.py": "workers.scene.plan, workers.render.raster.gbuffer, workers.store.local",
    }
    done = lint(tmp_path, allowed)
    assert done.returncode == 0, done.stdout + done.stderr

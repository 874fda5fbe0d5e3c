"""The layer rules in pyproject.toml, each broken on purpose, and what a start must not load, for which somebody would wait."""

import pkgutil
import re
import shutil
import subprocess
import sys
from pathlib import Path

from services.study.command import PACKAGES

ROOT = Path(__file__).resolve().parents[1]

FORBIDDEN = (
    ("schemas.job.job", "workers.thing", "never back"),
    ("workers.shard.run_shard", "services.thing", "never back"),
    ("schemas.job.job", "schemas.scene.thing", "schemas: what is stored"),
    ("schemas.capture", "schemas.dataset.thing", "schemas: what is stored"),
    ("workers.render.tiers", "workers.scene.thing", "stages apart"),
    ("workers.assets.mass", "workers.physics.thing", "stages apart"),
    ("workers.geometry.hull", "workers.physics.thing", "stages apart"),
    ("workers.door.opening", "workers.assets.thing", "stages apart"),
    ("workers.scene.draw.plan", "workers.shard.thing", "stages apart"),
    ("workers.geometry.hull", "subprocess", "geometry is pure"),
    ("services.merge.merge", "services.run.thing", "services: commands"),
    ("services.read.query", "services.dataset.thing", "services: commands"),
    ("services.read.independent.derive", "workers.geometry.thing", "the independent derivation"),
    ("services.read.independent.derive", "schemas.dataset.thing", "the independent derivation"),
    ("services.read.independent.poses", "services.read.verify", "the independent derivation"),
    ("schemas.scene.scene", "trimesh", "schemas load nothing heavy"),
    ("workers.shard.run_shard", "ray", "workers never import Ray"),
    ("services.cli.main", "ray", "Ray is known"),
    ("workers.scene.ray_check", "pybullet", "PyBullet is imported in one file"),
    ("services.bench.measure", "pybullet", "PyBullet is imported in one file"),
    ("workers.store.images", "OpenGL", "OpenGL stays in its room"),
    ("services.look.report", "pyrender", "OpenGL stays in its room"),
    ("workers.render.tiers", "mitsuba", "Mitsuba stays in one file"),
    ("workers.capture.surface.fusion", "skimage", "each known to one file"),
    ("services.capture", "reportlab", "each known to one file"),
    ("services.look.report", "matplotlib", "The packages of the extra"),
    ("services.run.run_job", "prometheus_client", "Prometheus is known to one file"),
)

ALLOWED = (
    ("services.run.coordinator", "ray"),
    ("services.cli.main", "services.run.coordinator"),
    ("workers.physics.bullet", "pybullet"),
    ("workers.render.raster.gbuffer", "OpenGL.GL"),
    ("workers.scene.pairs", "workers.geometry.thing"),
    ("workers.assets.mass", "workers.door.thing"),
    ("workers.store.local", "schemas.dataset.thing"),
    ("workers.scene.draw.plan", "workers.physics.thing, workers.assets.thing"),
    ("workers.shard.run_shard", "workers.scene.draw.plan, workers.render.raster.gbuffer, workers.store.local"),
)


def lint(project: Path, imports: tuple[tuple[str, ...], ...]) -> subprocess.CompletedProcess[str]:
    """Checks a skeleton of the three packages in which these modules import these."""
    shutil.copy(ROOT / "pyproject.toml", project)
    for top in ("schemas", "workers", "services"):
        for folder in [ROOT / top, *(path for path in (ROOT / top).rglob("*") if (path / "__init__.py").exists())]:
            package = project / folder.relative_to(ROOT)
            package.mkdir()
            for name in ("__init__.py", "thing.py"):
                (package / name).touch()
        for file in (ROOT / top).rglob("*.py"):
            (project / file.relative_to(ROOT)).touch()
    for module, imported, *_ in imports:
        with (project / (module.replace(".", "/") + ".py")).open("a") as written:
            written.write(f"import {imported}\n")
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    return subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)


def test_every_forbidden_import_is_found_by_its_rule(tmp_path):
    done = lint(tmp_path, FORBIDDEN)
    assert done.returncode == 1, done.stdout + done.stderr
    told = re.split(r"\n\n\n(?=.*\n-+\n)|----\n\n(?=.*\n-+\n)", done.stdout.partition("Broken contracts")[2])
    for module, imported, rule in FORBIDDEN:
        (section,) = (section for section in told if rule in section.partition("\n")[0])
        assert f" {module} -> {imported} (" in section, (module, imported)


def test_what_the_rules_allow_passes(tmp_path):
    done = lint(tmp_path, ALLOWED)
    assert done.returncode == 0, done.stdout + done.stderr


HEAVY = {"ray", "numpy", "cv2", "scipy", "pydantic", "pyarrow", "av", "OpenGL", "pybullet", "trimesh"}
HELP = "try: services.cli.main.build_parser().parse_args(['capture', '--help'])\nexcept SystemExit: pass"
SCHEMAS = [module.name for module in pkgutil.walk_packages([str(ROOT / "schemas")], "schemas.")]
NO_EXTRA = f"import sys; sys.modules.update(dict.fromkeys({sorted(PACKAGES)!r}))"
"""The message that names it is what a user sees then, and no ImportError."""

STARTS = (
    (
        (f"import verso, services.cli.main\n{HELP}", HEAVY | {"yaml", "schemas.job", "asyncio"}),
        (
            f"import {', '.join(SCHEMAS)}",
            {"OpenGL", "pyrender", "pyglet", "pybullet", "ray", "cv2", "trimesh", "scipy"},
        ),
        ("from workers.store.local import open_store; open_store('/tmp')", {"obstore", "ray"}),
        ("import services.dataset.dataset", {"ray", "pybullet", "OpenGL", "duckdb"}),
        (f"{NO_EXTRA}; import services.bench.command, services.study.command", {"ray"}),
    ),
    (("import services.study.page", {"matplotlib.pyplot"}),),
)
"""By process: what starts one after the other, and what is not loaded then."""


def test_a_start_loads_nothing_heavy():
    assert len(SCHEMAS) > 15
    for starts in STARTS:
        steps = [f"{start}\nimport sys; assert not {{*sys.modules}} & {heavy}, {start!r}" for start, heavy in starts]
        done = subprocess.run([sys.executable, "-P", "-c", "\n".join(steps)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

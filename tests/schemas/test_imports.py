"""Importing what describes data must not load what makes it."""

import pkgutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("OpenGL", "pyrender", "pyglet", "pybullet", "ray", "cv2", "trimesh", "scipy")


def loaded_after(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after running `code`."""
    script = f"{code}\nimport sys\nprint(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_schemas_loads_neither_GL_nor_physics_nor_ray():
    names = ["schemas", *(module.name for module in pkgutil.walk_packages([str(ROOT / "schemas")], "schemas."))]
    assert len(names) > 18
    assert loaded_after(f"import {', '.join(names)}").isdisjoint(HEAVY)


def test_the_heavy_modules_are_found_by_this_test_where_they_are_loaded():
    assert "pybullet" in loaded_after("import workers.physics.settle")


def test_the_command_line_explains_itself_without_loading_what_it_drives():
    code = "import services.cli.main\nfrom services.cli.parser import build_parser\nbuild_parser().format_help()"
    assert loaded_after(code).isdisjoint({*HEAVY, "numpy", "pyarrow", "pydantic"})

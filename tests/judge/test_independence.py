"""The judge shares no code with what it judges."""

import ast
import subprocess
import sys
from pathlib import Path

ROOM = Path(__file__).parent
JUDGE = ("contacts", "judge", "nearest", "overlap", "solids", "statics", "surface")
LIBRARIES = {"collections", "dataclasses", "functools", "itertools", "fcl", "manifold3d", "numpy", "scipy"}


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def is_allowed(name: str) -> bool:
    own = {f"tests.judge.{module}" for module in JUDGE} | {"schemas.base", "schemas.scene.shape"}
    return name in own or name.split(".")[0] in LIBRARIES


def test_the_judge_imports_libraries_and_the_types_of_meshes_alone():
    for module in JUDGE:
        assert [name for name in imported(ROOM / f"{module}.py") if not is_allowed(name)] == []
    assert not is_allowed("workers.physics.placement") and not is_allowed("trimesh")


def test_loading_the_judge_loads_nothing_of_the_workers():
    loaded = (
        "import sys, tests.judge.judge; print([name for name in sys.modules if name.split('.')[0] in sys.argv[1:]])"
    )
    command = [sys.executable, "-c", loaded, "workers", "services", "pybullet", "trimesh"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOM.parents[1])
    assert done.stdout.strip() == "[]"

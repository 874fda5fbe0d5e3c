"""The digest of the source."""

import shutil
import subprocess
import sys
from pathlib import Path

from workers.shard.code import SOURCE_PACKAGES, code_digest

ROOT = Path(__file__).resolve().parents[3]
LOOK = "import sys; sys.path.insert(0, '.'); from workers.shard.code import code_digest"
ASK = [sys.executable, "-P", "-c", f"{LOOK}; print(code_digest(), 'numpy' in sys.modules)"]


def test_a_copy_has_the_same_digest_and_a_changed_line_another(tmp_path):
    for package in SOURCE_PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))

    def ask() -> list[str]:
        return subprocess.run(ASK, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()

    assert ask() == [code_digest(), "False"]
    with (tmp_path / "workers" / "scene" / "plan.py").open("a") as file:
        file.write("# changed\n")
    assert ask()[0] != code_digest()

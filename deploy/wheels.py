"""Builds the two wheels: `./verso wheels DIR`.

`verso-data` is the whole, for the machines that make data. `verso-read` is what reads a dataset: pure Python for any platform
and CPython 3.10 to 3.14, all of it below one import package, `verso`. Its files are the modules that the commands and the Python
door of reading import when they are loaded; what they import within `needs_making` makes data and stays out. The names of
verso-data's packages stay as they are: processes of a run start by them, and Ray's tasks are pickled by them.
"""

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
OURS = ("schemas", "workers", "services")


def _folder(room: str) -> Path:
    return ROOT.joinpath(*room.split("."))


DOORS = (
    *("verso", "services.dataset.dataset"),
    *("services.cli.commands", "services.cli.main", "services.cli.reference", "services.job.job_file"),
    *(
        f"{room}.{file.stem}"
        for room in ("services.export", "services.look")
        for file in sorted(_folder(room).glob("[a-z]*.py"))
    ),
    *("services.read.columns_page", "services.read.query", "services.read.status", "services.read.verify"),
    *("services.score.command", "services.score.leaderboard"),
    *("workers.pool", "workers.store.file_system", "workers.store.objects"),
)
"""What reading begins with: tables name commands and formats, and nothing imports them. Two rooms do nothing else."""

EPOCH = "1577836800"
"""2020-01-01: the time of every file in a wheel, so that the same source gives the same bytes."""

_IMPORT = re.compile(rf"^(\s*)(from|import) ({'|'.join(OURS)})\b", re.MULTILINE)


def file_of(module: str) -> Path | None:
    """The file of a module of ours; None where it is none, or not a module but a name in one."""
    base = _folder(module)
    return next((file for file in (base.with_suffix(".py"), base / "__init__.py") if file.is_file()), None)


def imports_of(path: Path) -> Iterator[str]:
    """The modules that a file imports when it is loaded, and within its functions those of other projects."""

    def walk(node: ast.AST, loaded: bool) -> Iterator[str]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue
            if isinstance(child, ast.With) and "needs_making(" in ast.unparse(child.items[0].context_expr):
                continue
            if isinstance(child, ast.Import):
                names = [alias.name for alias in child.names]
            elif isinstance(child, ast.ImportFrom):
                below = [f"{child.module}.{alias.name}" for alias in child.names]
                names = [name if file_of(name) else str(child.module) for name in below]
            else:
                names = []
                yield from walk(child, loaded and not isinstance(child, ast.FunctionDef | ast.Lambda))
            yield from (name for name in names if loaded or name.split(".")[0] not in OURS)

    return walk(ast.parse(path.read_text()), True)


def reading_modules() -> tuple[dict[str, Path], set[str]]:
    """The files of every module that reading loads, by name; and the packages of others that these import."""
    ours: dict[str, Path] = {}
    others: set[str] = set()
    waiting = list(DOORS)
    while waiting:
        name = waiting.pop()
        path = file_of(name)
        if path is None:
            others.add(name.split(".")[0])
        elif name not in ours:
            ours[name] = path
            waiting += imports_of(path)
    return ours, {name for name in others if name not in sys.stdlib_module_names}


def write_reader(folder: Path) -> None:
    """The source tree of verso-read: reading modules below `verso`, their data, and a pyproject.toml."""
    package = folder / "verso"
    modules, _ = reading_modules()
    for name, path in modules.items():
        relative = Path("__init__.py") if name == "verso" else path.relative_to(ROOT)
        place = package / relative
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(_IMPORT.sub(r"\1\2 verso.\3", path.read_text()))
    for below in {place.parent for place in package.rglob("*.py")}:
        (below / "__init__.py").touch()
    shutil.copytree(ROOT / "services/look/web", package / "services/look/web")
    (package / "py.typed").touch()
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text())
    shutil.copyfile(ROOT / "LICENSE", folder / "LICENSE")
    lines = [
        '[build-system]\nrequires = ["setuptools>=77"]\nbuild-backend = "setuptools.build_meta"\n\n[project]',
        f'name = "verso-read"\nversion = "{whole["project"]["version"]}"',
        'description = "Reads datasets that Verso made: Python, SQL, exports, checksums, pages"',
        'requires-python = ">=3.10"\nlicense = "MIT"\nlicense-files = ["LICENSE"]',
        f"dependencies = {whole['dependency-groups']['reading']!r}",
        '[project.scripts]\nverso = "verso.services.cli.main:main"',
        '[tool.setuptools.packages.find]\ninclude = ["verso", "verso.*"]',
        '[tool.setuptools.package-data]\n"*" = ["py.typed", "**/*.html", "**/*.css", "**/*.js", "**/*.svg", "**/*.LICENSE"]',
    ]
    (folder / "pyproject.toml").write_text("\n".join(lines) + "\n")


def write_whole(folder: Path) -> None:
    """The source tree of verso-data: what git would build, without what an earlier build left."""
    folder.mkdir(exist_ok=True)
    for name in OURS:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".loops"))
    for name in ("verso.py", "pyproject.toml", "LICENSE"):
        shutil.copyfile(ROOT / name, folder / name)


def build(tree: Path, out: Path) -> None:
    """The wheel of a source tree, by the setuptools that is installed here."""
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--disable-pip-version-check", "--quiet")
    command = [sys.executable, "-m", "pip", "wheel", *options, "-w", str(out), str(tree)]
    subprocess.run(command, check=True, env={**os.environ, "SOURCE_DATE_EPOCH": EPOCH})


def main() -> None:
    """Write both wheels."""
    parser = argparse.ArgumentParser(prog="verso wheels", description="Builds the wheels verso-data and verso-read.")
    parser.add_argument("dir", metavar="DIR", type=Path, help="folder that the wheels go to; it is made")
    out = parser.parse_args().dir.resolve()
    out.mkdir(parents=True, exist_ok=True)
    os.umask(0o022)
    for write in (write_whole, write_reader):
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            build(Path(folder), out)
    print("\n".join(sorted(str(path) for path in out.glob("verso_*.whl"))))


if __name__ == "__main__":
    main()

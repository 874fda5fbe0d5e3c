"""What the project's own source is: its digest, and the folder of the loops compiled from it.

Loads nothing heavy: a node tells the digest first of all, and numba alone takes half a second to load.
"""

import hashlib
import re
from functools import cache
from pathlib import Path

from schemas.environment import cache_folder

ROOT = Path(__file__).resolve().parents[1]

SOURCE_PACKAGES = ("schemas", "workers")
"""Packages of the project that the bytes depend on: not the services that drive it."""


@cache
def code_digest() -> str:
    """SHA-256, hex, of the source files that the bytes depend on, by path."""
    digest = hashlib.sha256()
    for path in sorted(path for package in SOURCE_PACKAGES for path in (ROOT / package).rglob("*.py")):
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


MADE_WITH_THE_CODE = ROOT / ".loops"
"""Where an image has loops that were compiled when it was built. It may be read-only: they are copied from there."""


def folder_name(root: Path = ROOT) -> str:
    """The folder's name, by the place and text of each file of the project that has a loop, and of all that these import."""
    found = {path for path in (root / "workers").rglob("*.py") if "\n@compiled" in path.read_text()}
    ahead = list(found)
    while ahead:
        for module in re.findall(r"^from ((?:schemas|workers)[\w.]*) import", ahead.pop().read_text(), re.MULTILINE):
            path = root / f"{module.replace('.', '/')}.py"
            if path.exists() and path not in found:
                found.add(path)
                ahead.append(path)
    texts = sorted(f"{path}\0{path.read_text()}" for path in found)
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()
    return f"loops-{digest[:16]}"


def are_kept(own: str | None) -> bool:
    """Whether no planned loop of this code is still to be compiled; `own` is NUMBA_CACHE_DIR, if the user set it.

    Of one kind of processor: where others keep theirs in the same folder, this may be told too early.
    """
    name, cache = folder_name(), Path(own) if own else cache_folder("loops")
    places = [folder / name for folder in (cache, MADE_WITH_THE_CODE) if folder is not None]
    planned = [path for path in (ROOT / "workers").rglob("*.py") if "\n@compiled_for" in path.read_text()]
    modules = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in planned]
    return any(all(any(place.glob(f"{module}-*.kept")) for module in modules) for place in places)

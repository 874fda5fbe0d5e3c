"""The digest of the project's source. Loads nothing heavy, so that a node can tell it first of all."""

import hashlib
from functools import cache
from pathlib import Path

SOURCE_PACKAGES = ("schemas", "workers")
"""Packages of the project that the bytes depend on: not the services that drive it."""


@cache
def code_digest() -> str:
    """SHA-256, hex, of the source files that the bytes depend on, by path."""
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for path in sorted(path for package in SOURCE_PACKAGES for path in (root / package).rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()

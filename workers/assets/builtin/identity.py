"""What names a built-in instance, without what makes its shape."""

VERSION = 2
"""Part of the catalogue's digest: raise it with every change to a vertex or colour of any instance."""


def instance_id(category: str, seed: int, index: int) -> str:
    """`mug-0-000123`: category, seed, and the index in six digits, so that ids sort."""
    return f"{category}-{seed}-{index:06d}"

"""Code blocks of documentation pages, to be run as they are printed."""

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def blocks_of(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page in one language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


def run_blocks(page: Path) -> dict:
    """Runs the Python blocks of a page one after the other, in one namespace, which comes back."""
    names: dict = {}
    for number, block in enumerate(blocks_of(page, "python")):
        exec(compile(block, f"{page.name}, block {number + 1}", "exec"), names)
    return names

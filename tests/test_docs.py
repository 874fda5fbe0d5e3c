"""The documents: their links lead somewhere, and the commands that they print are commands."""

import itertools
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

from services.cli.main import build_parser

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("deploy/**/*.md")])

_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_CODE = re.compile(r"^```.*?^```$|`[^`\n]+`", re.MULTILINE | re.DOTALL)
_FENCE = re.compile(r"^```(?:\w+)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_link_leads_to_a_file_and_a_heading_that_are_there():
    for page in PAGES:
        for target in _LINK.findall(_CODE.sub("", page.read_text())):
            path, _, anchor = target.partition("#")
            file = (page.parent / path) if path else page
            if not re.match(r"[a-z]+:", target):
                assert file.exists() and (not anchor or anchor in anchors(file)), f"{page}: {target}"


def blocks(text: str) -> Iterator[str]:
    """What stands in fenced blocks, and in blocks indented by four spaces."""
    yield from _FENCE.findall(text)
    plain = _FENCE.sub("", text)
    yield from (
        "\n".join(line[4:] for line in block.splitlines()) for block in re.findall(r"(?:^    .*\n?)+", plain, re.M)
    )


def commands(text: str) -> Iterator[list[str]]:
    """The words of every `verso` command in the blocks; a quoted argument may go over several lines."""
    for block in blocks(text):
        lines = block.replace("\\\n", " ").splitlines()
        while lines:
            line = lines.pop(0)
            match = re.match(r"(?:\$ )?(?:\./)?verso (.*)", line)
            while match and line.count('"') % 2 and lines:
                line += " " + lines.pop(0).strip()
            if match:
                words = shlex.shlex(line.removeprefix("$ "), posix=True, punctuation_chars="&|>")
                words.whitespace_split = True
                for shell, part in itertools.groupby(words, lambda word: word in ("&&", "|", ">")):
                    command = list(part)
                    if not shell and command[0] in ("./verso", "verso"):
                        yield command[1:]


def test_every_command_in_a_block_is_one_that_the_command_line_takes(capsys):
    for page, words in ((one, words) for one in PAGES for words in commands(one.read_text())):
        if words[:1] == ["test"] or words[-1:] in (["--help"], ["--version"]):
            continue  # parsed by their own handlers
        try:
            build_parser().parse_args(words)
        except SystemExit:
            raise AssertionError(f"{page}: verso {shlex.join(words)}: {capsys.readouterr().err}") from None


def test_commands_are_found():
    query = './verso query d "select 1\n        from t" && verso status d'
    text = f"x\n\n    $ ./verso run a.yaml  # so\n    {query}\n\n```\nverso doctor\n```\n"
    assert list(commands(text)) == [["doctor"], ["run", "a.yaml"], ["query", "d", "select 1 from t"], ["status", "d"]]

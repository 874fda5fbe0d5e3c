"""docs/export.md: every command and every example of the page is run, in its order, on a small dataset."""

import re
import shlex
from pathlib import Path

import pytest

from services.cli.main import main
from services.export.table import FORMATS
from tests.services.export.exported import contents

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "export.md").read_text()
COMMANDS = [
    shlex.split(line, comments=True)[1:] for line in PAGE.splitlines() if line.strip().startswith("verso export")
]
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(files, shaped, studio, tmp_path_factory):
    """A folder in which the page's commands were run."""
    place = tmp_path_factory.mktemp("page")
    (place / "data").mkdir()
    (place / "data" / "tabletop").symlink_to(files.name)
    (place / "data" / "targets").symlink_to(shaped.name)
    (place / "data" / "studio").symlink_to(studio.name)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        for words in COMMANDS:
            assert main(words) == 0, words
    return place


@pytest.mark.minute
def test_every_command_of_the_page_exports(folder):
    assert len(COMMANDS) == 15 and "`--shard-mb` (256)" in PAGE
    assert {words[words.index("--format") + 1] for words in COMMANDS} == set(FORMATS)
    for words in COMMANDS:
        assert (folder / words[2] / "export.json").exists() and not (folder / words[2] / "_export").exists()


@pytest.mark.minute
@pytest.mark.parametrize("example", EXAMPLES)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_the_examples_run(example, folder, monkeypatch):
    found = re.search(r"^import (webdataset|datasets)\b", example, re.MULTILINE)
    assert found is not None
    pytest.importorskip(found[1])
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(example, names)
    if found[1] == "webdataset":
        assert names["colour"].shape == (120, 160, 3) and names["depth"].dtype == "uint16" and len(names["pose"]) == 16
        last = names["pair"]["json"]  # the loop's last pair: as many pixels of its object as were counted
        (thing,) = (one for one in last["views"]["mirror"]["objects"] if one["region_id"] == 3)
        assert names["mask"].sum() == thing["pixels"] > 100
    else:
        assert names["depth"].size == (160, 120) and names["depth"].mode.startswith("I")


def test_the_page_names_every_kind_of_file_that_an_export_writes(folder):
    """Numbers in names are read as the patterns that the page writes."""
    told = re.sub(r"%05d", "#", re.sub(r"[0-9]{5,}", "#", PAGE))
    for words in COMMANDS[: len(FORMATS)]:
        for path in contents(folder / words[2]):
            name = re.sub(r"[0-9]{5,}", "#", path.rpartition("/")[2])
            if path.startswith("shapes/") or "/complete/" in path:
                name = f"<instance_id>{path[-4:]}"
            name = re.sub(r"^0[0-9]\.pcd", "00.pcd", re.sub(r"^[0-9]{4}_", "0000_", name))
            name = re.sub(r"^[0-9]{3}(?=[._])", "000", name)
            known = re.sub(r"^(segmentIn|depthIn)", "rgbIn", name)
            known = re.sub(r"#([._])(aligned|mirror|projected)\.", r"#\1input.", known)
            assert known in told, f"{words[2]}/{path}"

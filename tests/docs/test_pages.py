"""Pages: links lead somewhere, commands are commands, and every one and every Python block runs as a user types them.

They run in the order of the page, in a fresh checkout, which holds README's first dataset, which the other pages are about, and
what a user brings: meshes, a recording, a scan.
"""

import importlib.util
import itertools
import re
import shlex
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

from schemas.job.assets import ProceduralSource
from schemas.job.captures import KinectDepthNoise, Simulate
from schemas.job.views import RgbNoise
from services.cli.main import build_parser
from services.queue.queue import RESTARTS, JobState
from services.queue.supervise import PAUSES_S
from tests.services.init.own_meshes import cup, write_mesh
from tests.workers.door.recordings import recording
from tests.workers.door.test_readers import write_realsense
from workers.assets.builtin.make import make_asset
from workers.capture.board_kinds import KINDS, BoardSizes
from workers.capture.simulate.simulate import simulate_capture
from workers.scene.chance import SceneChance

ROOT = Path(__file__).resolve().parents[2]
DIGEST = "8e0766d758f3dc1a44bd188d1c050011348bd71978498ac5458bca0a9fe7a858"
FIRST = "./verso run deploy/jobs/tabletop.yaml"

ELSEWHERE = {
    r"docker |kubectl ": "tests/deploy/test_compose.py",
    r"RAY_UP\w*=\S+ |\.venv/bin/ray ": "tests/clusters and tests/deploy/test_submit.py",
    r"\./verso lock": "tests/launcher; it asks PyPI for what is newest",
    r"\./verso drive |\./verso supervise --address http://head": "tests/services/queue, with a Ray of their own",
    r"\.venv/bin/python -m pip install torch": "some gigabytes",
}
"""Commands that cannot run on any machine, and what runs them or why nothing does."""

FOR_A_WHILE = r"\./verso (serve|supervise|logs .*--follow)"
"""Commands that end when they are told to."""

TINY = "--set captures.simulate.image_scale=0.3"

SMALLER = {
    r"--scenes [46]00\b": "--scenes 16",
    r"(run deploy/jobs/benchmark.yaml)": r"\1 --scenes 24",
    r"^\./verso test$": "./verso test tests/test_layers.py",
    r"tests/hard_cases": "tests/test_layers.py",
    r"--scenes 64 --workers 2": "--scenes 2",
    r"(\./verso tradeoff .*)": r"\1 --budget 60s --knobs step",
    r"(--out data/(targets|studio))": r"\1 --scenes 2",
    r"(run deploy/jobs/captures.yaml)": r"\1 --scenes 1 --set captures.simulate.views=8 " + TINY,
    r"--views 40 --category mug": f"--views 10 --category mug {TINY}",
    r"~/my_meshes": "meshes",
    r"/shared/": "shared/",
    r"s3://bucket/": "bucket/",
    r"(train_\w+.py data/\w+)": r"\1 --epochs 1",
    r"predictions/a predictions/b": "predictions",  # which the page has scored before
}
"""The same command with less to do, or in places that are here."""

PAGES = {
    "README.md": pytest.mark.minute,
    "docs/benchmark.md": pytest.mark.slow,
    "docs/captures.md": pytest.mark.slow,
    "docs/commands.md": pytest.mark.slow,
    "docs/export.md": pytest.mark.slow,
    "docs/measured.md": pytest.mark.minute,
    "docs/own_meshes.md": pytest.mark.slow,
    "docs/queue.md": pytest.mark.slow,
    "docs/report.md": pytest.mark.slow,
    "docs/scenes.md": pytest.mark.slow,
    "docs/studio.md": pytest.mark.slow,
    "docs/surroundings.md": pytest.mark.slow,
    "deploy/README.md": pytest.mark.minute,
    "deploy/examples/README.md": pytest.mark.slow,
}

READERS = ("docs/export.md", "docs/reading.md")
"""Pages that are typed where verso-read is installed, but for blocks of another one (tests/deploy/test_wheels.py)."""

_BLOCK = re.compile(r"^ *```(\w*) ?(\w*)\n(.*?)^ *```$|((?:^ {4,}[^\n]*\n)+)", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"(?:\w+=\S+ )*(?:\./verso|verso|docker|kubectl|\.venv/bin/\w+|export) ?")


def blocks(page: str) -> Iterator[tuple[str, str, str]]:
    """(language, installation, text) of every block of a page: ```sh checkout; without a word the page's own."""
    usual = "reader" if page in READERS else "checkout"
    for language, installation, text in blocks_in((ROOT / page).read_text()):
        yield language, installation or usual, text


def blocks_in(text: str) -> Iterator[tuple[str, str, str]]:
    for language, installation, fenced, indented in _BLOCK.findall(text):
        yield language, installation, textwrap.dedent(fenced or indented)


def steps(text: str) -> Iterator[tuple[str, str]]:
    """(language, what to run) of every block of a page: Python as a whole, of others each command."""
    return steps_of(blocks_in(text))


def steps_of(chosen: Iterable[tuple[str, str, str]]) -> Iterator[tuple[str, str]]:
    for language, _, text in chosen:
        if language == "python":
            yield "python", text
            continue
        lines = text.replace("\\\n", " ").splitlines()
        while lines:
            line = lines.pop(0).strip()
            while line.count('"') % 2 and lines:
                line += " " + lines.pop(0).strip()
            line = line.removeprefix("$ ")
            if language != "yaml" and _COMMAND.match(line):
                yield "sh", " ".join(re.sub(r"\s#\s.*", "", f"{line} ").split()) if '"' not in line else line


def test_every_page_with_a_block_is_run_and_steps_are_found_in_order():
    pages = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("deploy/**/*.md")]
    assert {str(page.relative_to(ROOT)) for page in pages if list(steps(page.read_text()))} <= {*PAGES, *READERS}
    text = 'x\n\n    $ ./verso run a  # so\n    made\n\n```python\nx = 1\n```\n\n- y\n\n      ./verso query d "a\n      b"\n'
    assert list(steps(text)) == [("sh", "./verso run a"), ("python", "x = 1\n"), ("sh", './verso query d "a b"')]
    assert next(line for _, line in steps((ROOT / "README.md").read_text())) == FIRST
    every = "\n".join(line for page in PAGES for _, line in steps((ROOT / page).read_text()))
    for pattern in (*ELSEWHERE, *SMALLER, FOR_A_WHILE):
        assert re.search(pattern, every, re.MULTILINE), f"{pattern} is not on any page any more"


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_link_leads_to_a_file_and_a_heading_and_every_command_is_one_that_the_command_line_takes(capsys):
    for page in [ROOT / "CHANGELOG.md", *(ROOT / page for page in (*PAGES, *READERS)), *ROOT.glob("docs/**/*.md")]:
        text = page.read_text()
        for target in re.findall(r"\[[^\]]*\]\(([^)\s]+)\)", re.sub(r"(?ms)^```.*?^```$|`[^`\n]+`", "", text)):
            path, _, anchor = target.partition("#")
            file = (page.parent / path) if path else page
            if not re.match(r"[a-z]+:", target):
                assert file.exists() and (not anchor or anchor in anchors(file)), f"{page}: {target}"
        for line in (line for language, line in steps(text) if language == "sh"):
            words = shlex.shlex(line, posix=True, punctuation_chars="&|>")
            words.whitespace_split = True
            for shell, part in itertools.groupby(words, lambda word: word in ("&&", "|", ">")):
                called, *given = part
                if shell or called not in ("./verso", "verso") or given[:1] == ["test"] or given[-1] == "--version":
                    continue
                try:
                    build_parser().parse_args(given)
                except SystemExit as ended:
                    if ended.code:
                        raise AssertionError(f"{page}: {line}: {capsys.readouterr().err}") from None


def test_the_queues_page_has_its_states_and_pauses():
    page = (ROOT / "docs" / "queue.md").read_text()
    listed = page.partition("## States")[2].partition("##")[0]
    assert re.findall(r"^- \*\*(\w+)\*\*: ", listed, re.MULTILINE) == list(get_args(JobState))
    assert f"rests for {', then '.join(f'{pause:g} s' for pause in PAUSES_S)}," in page
    assert RESTARTS == 3 and "three times at most" in page


def checkout_at(root: Path) -> Path:
    """A copy of the files that git has, with a `.venv` that the launcher takes for its own, and what a user brings."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, root / name)
    (root / ".venv").mkdir()
    for entry in Path(sys.prefix).iterdir():
        if not entry.name.startswith("verso-"):
            (root / ".venv" / entry.name).symlink_to(entry)
    stamp = re.search(r"^stamp_of\(\) \{.*?^\}\n", (root / "verso").read_text(), re.MULTILINE | re.DOTALL)
    assert stamp is not None
    for name in ("base", "dev", "study", "pathtraced"):
        script = f'root={root} venv={root}/.venv; {stamp[0]} stamp_of {name} >"$venv/verso-{name}"'
        subprocess.run(["bash", "-c", script], check=True)
    write_mesh(root / "meshes/mug/a.obj", cup())
    write_mesh(root / "meshes/mug/b.ply", cup(0.12, 0.05))
    write_mesh(root / "scan.ply", cup())
    (root / "recording.mkv").write_bytes(recording())
    predictions = root / "predictions" / "depth"
    predictions.mkdir(parents=True)
    for pose_id in range(1, 128, 2):  # of 64 scenes, all: below full coverage `score` ends with 1
        cv2.imwrite(str(predictions / f"{pose_id:05d}.png"), np.full((480, 640), 5 * 1300, np.uint16))
    for number, name in enumerate(("table", "floor")):
        (root / "photos" / name).mkdir(parents=True)
        cv2.imwrite(str(root / "photos" / name / "a.jpg"), np.full((90, 120, 3), 90 + 60 * number, np.uint8))
    (root / "shared").mkdir()  # what hosts see under one name
    return root


def type_it(line: str, root: Path, timeout: float = 900) -> str:
    """What a command prints. It must succeed, and name no program that is not there."""
    run = ["bash", "-c", line]
    done = subprocess.run(run, cwd=root, capture_output=True, text=True, check=False, timeout=timeout, errors="replace")
    told = done.stdout + done.stderr
    assert done.returncode == 0, f"{line}\n{told[-3000:]}"
    assert not re.search(r"(?<![\w./-])verso (?:run|report|query|status|verify|replay)\b", told), f"{line}\n{told}"
    return told


def type_for_a_while(line: str, root: Path) -> None:
    """Starts a command, gives it time to say something, and interrupts it: it must end without a word of Python's."""
    run = ["bash", "-c", f"exec {line}"]
    # Also where these tests run in the background.
    hears = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    out, err = subprocess.PIPE, subprocess.STDOUT
    with subprocess.Popen(run, cwd=root, preexec_fn=hears, stdout=out, stderr=err, text=True) as process:
        try:
            time.sleep(6)
            for attempts_left in (
                3,
                2,
                1,
                0,
            ):  # a shell that still prepares the environment, on a busy machine, loses one
                process.send_signal(signal.SIGINT)
                try:
                    told, _ = process.communicate(timeout=20)
                    break
                except subprocess.TimeoutExpired:
                    if not attempts_left:
                        raise
        finally:
            process.kill()
    assert process.returncode in (0, 1) and "Traceback" not in told, f"{line}\n{told}"


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Path:
    """A checkout in which README's first command was typed."""
    root = checkout_at(tmp_path_factory.mktemp("first"))
    told = type_it(FIRST, root)
    assert DIGEST in told and "next: ./verso report data/tabletop · ./verso query data/tabletop" in told
    return root


@pytest.mark.timeout(3600)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("page", [pytest.param(page, marks=mark) for page, mark in PAGES.items()])
def test_a_page_runs_from_top_to_bottom(page, first, tmp_path, monkeypatch):
    root = checkout_at(tmp_path)
    shutil.copytree(first / "data", root / "data")
    monkeypatch.chdir(root)
    monkeypatch.setenv("PYTHONPATH", "")
    if page == "docs/captures.md":
        write_realsense(made_on_charuco(tmp_path / "shots"), root / "recording.bag")
    names: dict = {}
    job = "j0a1b2c3d"
    for language, line in steps_of(block for block in blocks(page) if block[1] == "checkout"):
        if language == "python":
            if all(map(importlib.util.find_spec, re.findall(r"^import (\w+)$", line, re.MULTILINE))):
                exec(compile(line, page, "exec"), names)
            continue
        if line == FIRST and page == "README.md":
            continue  # typed for all pages
        if any(re.match(pattern, line) for pattern in ELSEWHERE) or ("train_" in line and not has_torch()):
            continue
        for pattern, less in SMALLER.items():
            line = re.sub(pattern, less, line)
        line = line.replace("j0a1b2c3d", job)
        if line.startswith("export "):
            name, _, value = shlex.split(line, comments=True)[1].partition("=")
            monkeypatch.setenv(name, value)
        elif re.match(FOR_A_WHILE, line):
            type_for_a_while(line, root)
        else:
            told = type_it(line, root)
            if line.startswith("./verso submit"):
                job = re.findall(r"\bj[0-9a-f]{8}\b", told)[0]


def made_on_charuco(folder: Path) -> Path:
    """A virtual capture of a mug on the board that the page of captures prints."""
    board = KINDS["charuco"](BoardSizes(12, 8, 0.037, 0.05, "DICT_4X4_50"))
    asset = make_asset("mug", ProceduralSource(source="procedural", size="metric"), 3, 600.0)
    settings = Simulate(views=8, image_scale=0.5, depth_noise=KinectDepthNoise(), rgb_noise=RgbNoise())
    simulate_capture(settings, board, asset, SceneChance(3, 0), folder)
    return folder


def has_torch() -> bool:
    return importlib.util.find_spec("torch") is not None

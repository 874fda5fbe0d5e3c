"""Mutated job files: each is a job or is refused in lines that a terminal can show, at a small and bounded cost."""

import random
import time
from collections import Counter
from pathlib import Path

import pytest
import yaml

from schemas.errors import JobError
from schemas.job.assets import ProceduralSource
from schemas.job.job import Job
from services.cli.main import main
from services.job.job_file import load_job
from services.run import dry_run
from tests.mutations import mutated_bytes, mutated_tree

EXAMPLES = sorted((Path(__file__).resolve().parents[3] / "deploy" / "jobs").glob("*.yaml"))

MOST_SECONDS = 5.0
"""Of processor time for one file: 0.05 s is usual; cores are shared and caches cold."""

MOST_MB = 200.0
"""By which a few hundred files may raise the peak of this process's memory."""


def mutated_job(number: int) -> bytes:
    """A job file: an example, or one with every key, mutated as text or as a tree."""
    dice = random.Random(number)
    data = dice.choice(EXAMPLES).read_bytes()
    tree = yaml.safe_load(data)
    if dice.random() < 0.5:
        tree = Job.model_validate(tree).model_dump(mode="json")
    if dice.random() < 0.4:
        return mutated_bytes(dice, dice.choice((data, yaml.safe_dump(tree).encode())))
    tree = mutated_tree(dice, tree)
    text = yaml.dump(
        tree, Dumper=yaml.CSafeDumper, default_flow_style=dice.choice((None, True, False)), sort_keys=False
    )
    return mutated_bytes(dice, text.encode()) if dice.random() < 0.2 else text.encode()


def peak_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def outcome(path: Path) -> str:
    """`job` or `refused`. Fails where it is neither."""
    try:
        job = load_job(path)
    except JobError as error:
        check_lines(str(error).splitlines(), path)
        return "refused"
    assert isinstance(job, Job)
    assert Job.model_validate(job.model_dump(mode="json")) == job
    return "job"


def check_lines(lines: list[str], path: Path) -> None:
    """Each line names the file, and is short and printable."""
    assert 1 <= len(lines) <= 21
    for line in lines:
        assert line.isprintable(), line
        assert len(line) < 800 + len(str(path)), line
        assert str(path) in line


def try_jobs(numbers: range, folder: Path, capsys: pytest.CaptureFixture[str]) -> Counter[str]:
    """Reads every mutated job, then gives it to the command line; counts the outcomes."""
    outcomes: Counter[str] = Counter()
    path, out = folder / "job.yaml", folder / "out"
    for number in numbers:
        path.write_bytes(mutated_job(number))
        started = time.process_time()
        found = outcome(path)
        outcomes[found] += 1
        built_in = found == "refused" or all(
            isinstance(source, ProceduralSource)
            for source in (*load_job(path).assets.objects, *load_job(path).assets.tables)
        )
        if built_in:  # others name folders of meshes, whose reading has tests of its own
            code = main(["run", str(path), "--dry-run", "--out", str(out)])
            told = capsys.readouterr()
            assert code == (2 if found == "refused" else code) and code in (0, 2), (number, told)
            assert "Traceback" not in told.out + told.err
            assert "\x1b" not in told.out + told.err
        assert time.process_time() - started < MOST_SECONDS, number
    assert sorted(folder.iterdir()) == [path]
    return outcomes


@pytest.fixture(autouse=True)
def unmeasured(monkeypatch):
    """A dry run makes some scenes to tell their cost; this is about reading jobs."""
    monkeypatch.setattr(dry_run, "measure_scene", lambda job, catalogue: None)


def test_a_hundred_mutated_jobs_are_jobs_or_are_refused(tmp_path, capsys):
    main(["run", str(EXAMPLES[-1]), "--dry-run", "--out", str(tmp_path / "out")])  # loads what reading a job loads
    before = peak_mb()
    outcomes = try_jobs(range(100), tmp_path, capsys)
    assert peak_mb() - before < MOST_MB
    assert outcomes["job"] > 5 and outcomes["refused"] > 40  # the mutations reach both


@pytest.mark.slow
def test_two_thousand_mutated_jobs_are_jobs_or_are_refused(tmp_path, capsys):
    main(["run", str(EXAMPLES[-1]), "--dry-run", "--out", str(tmp_path / "out")])
    before = peak_mb()
    assert try_jobs(range(100, 2100), tmp_path, capsys).total() == 2000
    assert peak_mb() - before < MOST_MB

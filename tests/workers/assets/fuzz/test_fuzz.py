"""Mutated assets: each is read as a sound asset or refused with its reason, within limits of time and memory."""

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from schemas.scene.shape import Asset
from tests.workers.assets.fuzz.mutations import mutant
from tests.workers.assets.oracles import write
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.reader import Request, Task, ask, unpack_asset

SEED = 20260101
QUICK, ALL = 60, 3600
SETTINGS = FolderSource(source="urdf", folder=".")
MOST_S = 10
"""Processor seconds within which each mutant is listed, checked or loaded."""
REASONS = {
    "format", "index_out_of_range", "missing", "name", "no_faces", "no_hull", "no_size", "not_finite", "size",
    "too_large", "too_slow", "unreadable",
}  # fmt: skip


@dataclass
class Trial:
    """What one mutant came to, and how long reading it took."""

    what: str
    outcome: str
    wall_s: float


def read(folder: Path, files: dict[str, bytes], what: str) -> tuple[Trial, Asset | None]:
    """A mutant's files written below a folder, listed, checked and loaded as the catalogue does."""
    for name, data in files.items():
        write(folder / name, data)
    path, begun = folder / next(iter(files)), time.perf_counter()
    entry: Entry | None = None
    answer: bytes | MeshError = b""
    for kind in ("list", "check", "load"):
        request = Request(
            SETTINGS, folder, Assets(limits=MeshLimits(max_cpu_s=MOST_S)), (Task(kind, path, "mug", entry),)
        )
        (answer,) = ask(request)
        if isinstance(answer, MeshError):
            check_refusal(answer, folder, what)
            return Trial(what, answer.reason, time.perf_counter() - begun), None
        if kind == "list":
            entry = Entry("a", tuple(SourceFile(*file) for file in json.loads(answer)), "MIT")
            assert all((folder / file.path).resolve().is_relative_to(folder.resolve()) for file in entry.files), what
    assert isinstance(answer, bytes)
    asset = unpack_asset(answer)
    check_asset(asset, what)
    return Trial(what, "read", time.perf_counter() - begun), asset


def check_refusal(error: MeshError, folder: Path, what: str) -> None:
    """A known reason, the file's name, one line, and no fault of the machine."""
    assert error.reason in REASONS, (what, error)
    assert error.kind == "intrinsic", (what, error)
    assert "a." in error.detail or str(folder) in error.detail, (what, error)
    assert error.detail.isprintable() and len(error.detail) < 1100, (what, error)


def check_asset(asset: Asset, what: str) -> None:
    """Finite and in range, centred, no larger than allowed, and weighed as its volume or area says."""
    vertices, faces = asset.shape.vertices, asset.shape.faces
    assert np.isfinite(vertices).all() and faces.min() >= 0 and faces.max() < len(vertices), what
    size = float(np.linalg.norm(asset.extents_m))
    limits = Assets().limits
    assert limits.min_size_m * 0.999 <= size <= limits.max_size_m * 1.001, what
    assert np.abs(asset.shape.bounds.sum(axis=0)).max() <= 1e-6 * size, what
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    if asset.watertight:
        volume = float((a * np.cross(b, c)).sum() / 6.0)
        assert asset.mass.mass_kg == pytest.approx(600.0 * volume, rel=1e-3, abs=1e-9 * size**3), what
    else:
        area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)
        assert asset.mass.mass_kg == pytest.approx(3.0 * area, rel=1e-3), what
    assert asset.mass.mass_kg > 0.0 and np.isfinite(asset.mass.inertia).all(), what
    assert len(asset.notes) <= 20 and all(note.isprintable() for note in asset.notes), what


def run(tmp_path: Path, indices: range) -> list[Trial]:
    """Every mutant's trial."""
    trials = []
    for index in indices:
        what, files = mutant(SEED, index)
        folder = tmp_path / str(index)
        trial, _ = read(folder, dict(files), f"{index}: {what}")
        shutil.rmtree(folder)
        trials.append(trial)
    assert [trial for trial in trials if trial.outcome == "too_slow"] == []
    return trials


def test_some_mutants_are_read_or_refused_and_nothing_else(tmp_path):
    trials = run(tmp_path, range(QUICK))
    assert {"read", "unreadable"} < {trial.outcome for trial in trials}


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", range(12))
def test_thousands_of_mutants_are_read_or_refused_and_nothing_else(tmp_path, part, capsys):
    step = ALL // 12
    trials = run(tmp_path, range(part * step, (part + 1) * step))
    slowest = max(trials, key=lambda t: t.wall_s)
    outcomes = sorted({t.outcome for t in trials}, key=lambda o: -sum(t.outcome == o for t in trials))
    counts = ", ".join(f"{sum(t.outcome == o for t in trials)} {o}" for o in outcomes)
    with capsys.disabled():
        print(f"\n{len(trials)} mutants: {counts}; slowest {slowest.wall_s:.1f} s ({slowest.what})")


def test_a_mutant_is_the_same_again():
    assert mutant(SEED, 17) == mutant(SEED, 17)
    assert len({tuple(mutant(SEED, index)[1].values()) for index in range(60)}) > 55

"""Simulated captures for tests: one function, kept for the process, because a photograph takes a second at full size."""

import functools
import tempfile
from dataclasses import dataclass
from pathlib import Path

from schemas.capture.view import CaptureTruth
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Board, Simulate
from workers.assets.builtin.make import make_asset
from workers.capture.simulate.effects import plan_effects
from workers.pipeline.captures.simulate import simulate_capture
from workers.plan.randomness import SceneChance
from workers.store.capture_folder import CaptureFolder, open_folder

KEPT = tempfile.TemporaryDirectory(prefix="verso-captures-")


@dataclass(frozen=True, eq=False)
class Made:
    """A capture on disk and its truth."""

    folder: CaptureFolder
    truth: CaptureTruth


def asset_of(category="can"):
    return make_asset(category, ProceduralSource(source="procedural"), 3, 600.0)


def made(seed=11, without=(), **settings):
    """A capture of a can by its seed and settings; effects `without` are asked for and withdrawn from the plan."""
    return _made(Simulate(**settings).model_dump_json(), seed, tuple(without))


@functools.cache
def _made(settings, seed, without):
    simulate = Simulate.model_validate_json(settings)
    path = Path(tempfile.mkdtemp(dir=KEPT.name))
    plan = plan_effects(simulate).without(*without)
    truth = simulate_capture(simulate, Board(), asset_of(), SceneChance(seed, 0), path, plan)
    return Made(open_folder(path), truth)

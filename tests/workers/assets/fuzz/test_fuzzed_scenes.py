"""Scenes of mutated assets that were accepted: made, or a row that says why not, and never an error that is a bug."""

from collections import Counter

import pytest

from schemas.job.job import Job
from tests.workers.assets.fuzz.mutations import mutant
from tests.workers.assets.fuzz.test_fuzz import SEED
from tests.workers.assets.oracles import write
from workers.assets.catalogue import open_catalogue
from workers.assets.external.verdicts import Verdicts
from workers.scene.context import Stopwatch, open_worker
from workers.shard.run_shard import run_scene


def make_scenes(folder, mutants, scenes):
    """What came of scenes whose objects are mutants that were accepted, by reason."""
    for index in mutants:
        for name, data in mutant(SEED, index)[1].items():
            write(folder / f"{index:04}" / name, data)
    source = {"source": "urdf", "folder": str(folder), "category_map": {"*/a.*": "mug"}}
    job = Job.model_validate({"name": "t", "categories": {"mug": 1}, "seed": 5, "assets": {"objects": [source]}})
    catalogue = open_catalogue(job.assets, folder, ("mug",), kept=Verdicts(None))
    context = open_worker(job, catalogue)
    outcomes: Counter[str] = Counter()
    for scene_id in range(scenes):
        output = run_scene(context, scene_id, Stopwatch())
        rows = output.rows.get("failures", [])
        outcomes.update([f"{row['stage']}: {row['reason']}" for row in rows] or ["made"])
    assert not [outcome for outcome in outcomes if outcome.startswith("assets")]
    return outcomes


def test_a_scene_is_made_of_an_accepted_mutant(tmp_path):
    assert make_scenes(tmp_path, range(24), 2).total() == 2


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_scenes_of_accepted_mutants_are_made_or_say_why_not(tmp_path, capsys):
    outcomes = make_scenes(tmp_path, range(400), 100)
    with capsys.disabled():
        print(f"\n{outcomes}")
    assert outcomes["made"] > 20

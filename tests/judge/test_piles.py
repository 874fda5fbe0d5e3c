"""Scenes of several objects, from a job to the table: settled, and judged."""

from pathlib import Path

import pytest
import yaml

from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ScenePlan
from tests.hard_cases.gate import verdicts, what_is_wrong
from tests.hard_cases.groups import Group
from tests.judge.hollows import CONTENTS, HOLLOWS, draw_hollow
from workers.assets.catalogue import open_catalogue
from workers.physics.effects import called_for
from workers.physics.pour import NOTHING_MORE, Pouring
from workers.physics.settle import settle_scene
from workers.scene.chance import SceneChance
from workers.scene.plan import plan_scene, pouring_of


def wrong_with(plan: ScenePlan, physics: Physics, pouring: Pouring = NOTHING_MORE) -> str:
    """What the judge says against a scene at rest. Raises SceneError."""
    effects = EffectPlan(tuple(sorted(called_for(plan.objects, plan.table, physics))), {})
    rest = settle_scene(plan, physics, effects, pouring)
    return what_is_wrong(verdicts(Group(rest.starts, plan.table), rest.settled, physics))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2024, 7])
@pytest.mark.parametrize(("objects", "kind", "count"), [(8, "table", 20), (15, "table", 10), (25, "bin", 5)])
def test_heaps_rest_through_the_gate_and_the_judge(objects, kind, count, seed):
    """All but one: a heap is chaotic, and another processor makes others. Docs/rest.md has the shares of more scenes."""
    document = yaml.safe_load(Path("deploy/jobs/pile.yaml").read_text())
    tables = [{"source": "procedural", "kind": kind}]
    document["assets"]["tables"], document["objects_per_scene"], document["seed"] = tables, objects, seed
    document.pop("verso")
    job, refused = Job.model_validate(document), []
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    for scene_id in range(count):
        chance = SceneChance(job.seed, scene_id)
        try:
            plan = plan_scene(job, catalogue, chance)
            assert wrong_with(plan, job.physics, pouring_of(job.start, chance, plan)) == "", scene_id
        except SceneError as error:
            refused.append(error)
    assert len(refused) <= 1


def test_every_kind_is_dropped_into_every_hollow_the_same_way_each_time():
    job = Job(name="t")
    plans = [draw_hollow(job, k) for k in range(len(HOLLOWS) * len(CONTENTS))]
    pairs = {(plan.objects[0].asset.sha256, plan.objects[1].asset.sha256) for plan in plans}
    assert len(pairs) == len(HOLLOWS) * len(CONTENTS)
    assert all(plan.objects[0].asset.watertight and plan.objects[1].asset.lofted is None for plan in plans)
    assert (draw_hollow(job, 3).objects[1].T_world_obj == plans[3].objects[1].T_world_obj).all()


@pytest.mark.minute
def test_what_is_dropped_into_a_hollow_rests_through_the_judge():
    """Hollows and contents are read from files: three kinds into each of four."""
    job = Job(name="t")
    for scene_id in range(12):
        assert wrong_with(draw_hollow(job, scene_id), job.physics) == "", scene_id

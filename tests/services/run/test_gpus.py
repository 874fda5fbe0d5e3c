"""A host with two GPUs, simulated: Ray counts two, and both stand for this machine's own graphics device."""

import os
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest

from schemas.job.job import Run
from services.job.job_file import validate_job
from services.run import coordinator, ray_cluster, run_job
from services.run.ray_cluster import RAY_PARTS, private_ray, share_gpus
from services.run.run_job import RunRequest
from services.run.worker_entry import enter_shard
from tests.datasets import SMALL, overlaid, run_here
from workers.render.raster import context, gbuffer
from workers.render.raster.context import GraphicsDevice


def test_shards_have_parts_of_gpus_that_leave_no_core_idle_and_no_gpu_unused():
    for nodes, running, keys, workers in [
        ([(8, 0)], 8, {}, None),
        ([(8, 0)], 8, {"device": "gpu", "workers_per_gpu": 3}, None),
        ([(0, 0), (8, 2)], 8, {}, 4),
        ([(8, 8)], 8, {}, 1),
        ([(16, 3)], 16, {}, 6),
        ([(16, 8)], 4, {}, 1),  # one each, not four on the first
        ([(16, 8)], 4, {"workers_per_gpu": 2}, 2),
        ([(16, 1), (2, 4)], 18, {}, 16),
        ([(16, 1), (2, 4)], 10, {}, 8),
        ([(8, 2), (8, 0)], 16, {}, None),  # the second node would stand idle
        ([(8, 2), (8, 0)], 16, {"device": "gpu"}, 4),
    ]:
        part = share_gpus([{"CPU": cores, "GPU": gpus} for cores, gpus in nodes], running, Run(**keys))
        assert (int(1 / part) if part else None) == workers, (nodes, running, keys)
        if part:
            assert workers * part <= 1 and part * RAY_PARTS == int(part * RAY_PARTS)
            if "workers_per_gpu" not in keys:
                most = sum(cores for cores, gpus in nodes if gpus)
                assert sum(min(cores, int(1 / part) * gpus) for cores, gpus in nodes) >= min(running, most)


def enter_on_simulated_gpus(folder: Path, *arguments):
    """What a worker does: its list of devices is made up, and it notes which of them it drew on."""
    egl: Any = context.load_egl()
    (own, *_), lists = egl.query_devices(), cast(Any, context)
    egl.get_device_by_index = lambda index: own
    lists.list_devices = lambda: tuple(GraphicsDevice(2 - n, f"card{n}", True, n) for n in range(2))
    report = enter_shard(*arguments)
    (renderer,) = gbuffer._shared.values()
    visible, span = os.environ["CUDA_VISIBLE_DEVICES"], report.spans[0].start
    (folder / f"{span}").write_text(f"{visible} {renderer.choice.index}")
    return report


@pytest.mark.ray
@pytest.mark.minute
@pytest.mark.timeout(300)
def test_a_run_on_two_gpus_draws_on_both_and_makes_the_same_bytes(tmp_path, monkeypatch):
    keys = {"scenes": 12, "run": {"range_size": 1, "shard_size": 1, "device": "any"}}
    job = validate_job(overlaid(SMALL, keys), "test")
    _, alone = run_here(job, tmp_path / "alone")
    noted = tmp_path / "noted"
    noted.mkdir()

    def enter(*arguments):
        return enter_on_simulated_gpus(noted, *arguments)

    monkeypatch.setattr(coordinator, "enter_shard", enter)
    monkeypatch.setattr(ray_cluster, "connection", partial(ray_cluster.connection, num_gpus=2))
    result = run_job.run_job(RunRequest(job, Path(), str(tmp_path / "out")), private_ray(2))
    assert (result.merged.digest, result.made_now) == (alone, 12)
    drawn = [file.read_text() for file in noted.iterdir()]
    assert len(drawn) == 12 and set(drawn) == {"0 2", "1 1"}, drawn

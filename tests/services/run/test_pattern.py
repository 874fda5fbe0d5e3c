"""What shards are given."""

from typing import cast

from schemas.dataset.shard import ShardOrder
from services.job.job_file import validate_job
from services.run.joining import Pattern
from services.run.worker_entry import WorkerTerms
from workers.assets.catalogue import Catalogue


def test_workers_of_a_private_ray_are_set_no_variables():
    order = ShardOrder.of("out", validate_job({"name": "small", "scenes": 2}, "test"), "j" * 64)
    assert Pattern(order, cast(Catalogue, None), WorkerTerms((("A", "1"),), "", "")).env_vars == {}

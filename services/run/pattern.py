"""What every shard of a run is given."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from schemas.dataset.shard import ShardOrder, ShardReport
from services.run.worker_entry import enter_shard
from services.run.worker_terms import WorkerTerms
from workers.assets.catalogue import Catalogue

EnterShard = Callable[[WorkerTerms, bytes, bytes], ShardReport]
"""Makes the shard of a pickled order with a pickled catalogue, in a worker."""


@dataclass(frozen=True)
class Pattern:
    """An order without ranges, the assets, and what its worker must have.

    `env_vars` are set for the workers of a cluster; those of a private Ray inherit them.
    """

    order: ShardOrder
    catalogue: Catalogue
    terms: WorkerTerms
    env_vars: Mapping[str, str] = field(default_factory=dict)
    enter: EnterShard = enter_shard
    """What a worker is given to do; simulations give something else."""

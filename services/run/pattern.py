"""What every shard of a run is given."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from schemas.dataset.shard import ShardOrder
from services.run.worker_terms import WorkerTerms
from workers.assets.catalogue import Catalogue


@dataclass(frozen=True)
class Pattern:
    """An order without ranges, the assets, and what its worker must have.

    `env_vars` are set for the workers of a cluster; those of a private Ray inherit them.
    """

    order: ShardOrder
    catalogue: Catalogue
    terms: WorkerTerms
    env_vars: Mapping[str, str] = field(default_factory=dict)

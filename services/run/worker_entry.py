"""Where a shard's task enters a worker: refuses a worker that would make other bytes, then loads what makes scenes.

What it is given is packed, so that Ray unpacks bytes and text alone: nothing of this project loads before the check, and a
node with other code is told as that. Ray itself loads numpy to unpack any argument, so what is checked is the environment
that the process was started with.
"""

import os
import pickle
import time
from functools import cache
from typing import TYPE_CHECKING

from services.run.sight import see
from services.run.worker_terms import WorkerTerms, refusal_of_worker

if TYPE_CHECKING:
    from schemas.dataset.shard import ShardReport

DRAIN = "VERSO_DRAIN"
"""The variable that names a file which exists once this node is to end: no range is begun then."""

DRAINED_PAUSE_S = 1.0
"""How long a node that is to end keeps a shard that it does not begin: Ray would hand it out there again and again."""


def enter_shard(terms: WorkerTerms, order: bytes, catalogue: bytes) -> "ShardReport":
    """The report of the shard whose order and catalogue are pickled. Raises VersoError where this worker is refused."""
    if is_draining():
        time.sleep(DRAINED_PAUSE_S)
    check_worker(terms)
    from workers.shard.run_shard import run_shard

    return run_shard(pickle.loads(order), pickle.loads(catalogue), is_draining)


@cache
def check_worker(terms: WorkerTerms) -> None:
    """Raises the refusal of this process; asked once in a process and run."""
    names = [name for name, _ in terms.environment]
    refusal = refusal_of_worker(terms, see(names, terms.proof, terms.token))
    if refusal is not None:
        raise refusal


def is_draining() -> bool:
    """Whether this node is to end, and so begins no range."""
    marker = os.environ.get(DRAIN)  # noqa: TID251 - the node's own, which no command line reaches
    return bool(marker) and os.path.exists(str(marker))

"""What a driver gives to its workers, and what it asks every node of a cluster before the first scene. Edge: Ray.

The question travels whole, so that a node without this project can answer, and it comes without the run's environment, so
that a processor that cannot have it is told instead of crashed.
"""

import os
import socket
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

import ray
from ray import cloudpickle
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from schemas.dataset.layout import FINGERPRINT_FILE, LOCK_FILE
from schemas.dataset.shard import ShardOrder
from services.run import worker_entry
from services.run.lock import Lock
from services.run.progress import say
from services.run.worker_entry import WorkerTerms, refusal_of, worker_environment
from workers.assets.catalogue import Catalogue
from workers.source import code_digest
from workers.store.store import Store


@dataclass(frozen=True)
class Pattern:
    """An order without ranges, the assets, and what its worker must have.

    `env_vars` are set for the workers of a cluster; those of a private Ray inherit them.
    """

    order: ShardOrder
    catalogue: Catalogue
    terms: WorkerTerms
    env_vars: Mapping[str, str] = field(default_factory=dict)


ANSWER_S = 60.0
"""Time for a node's answer: it may have to start a process for it. One that is silent is asked again by its workers."""


def check_nodes(terms: WorkerTerms) -> None:
    """Raises the refusal of the first node that cannot work on the run; nothing where the driver's node is the only one."""
    nodes = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
    if len(nodes) < 2:
        return
    for seen in _ask([node["NodeID"] for node in nodes], terms):
        refusal = refusal_of(terms, seen)
        if refusal is not None:
            raise refusal


def _ask(nodes: list[str], terms: WorkerTerms) -> list[worker_entry.Sight]:
    """What the nodes see, in their order; those that do not answer are said and left out."""

    def look(proof: str, token: str) -> dict:
        return asdict(worker_entry.see((), proof, token))

    cloudpickle.register_pickle_by_value(worker_entry)
    try:
        task = ray.remote(num_cpus=0, max_retries=0)(look)
        asked = [
            task.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(
                terms.proof, terms.token
            )
            for node in nodes
        ]
    finally:
        cloudpickle.unregister_pickle_by_value(worker_entry)
    seen, deadline = [], time.monotonic() + ANSWER_S
    for node, answer in zip(nodes, asked, strict=True):
        try:
            seen.append(worker_entry.Sight(**ray.get(answer, timeout=max(0.1, deadline - time.monotonic()))))
        except RayError as error:
            say(
                f"node {node[:12]} does not say what it has ({type(error).__name__}): its workers are asked before they begin"
            )
    return seen


def terms_of_driver() -> WorkerTerms:
    """What workers must have: this process's environment and code."""
    environ = os.environ  # noqa: TID251 - workers are to have what this process has
    environment = worker_environment(environ)
    return WorkerTerms(tuple(sorted(environment.items())), code_digest(), socket.gethostname())


def with_own_stack(store: Store, order: ShardOrder) -> ShardOrder:
    """The order of a strict job without commits, with this process's fingerprint, which every worker must then have.

    Left as it is where the job has commits, or wants a GPU and this host draws in software: then the first worker decides.
    """
    if order.terms.fingerprint_mode != "strict" or order.terms.fingerprint:
        return order
    from workers.render.raster.context import is_software
    from workers.render.raster.gbuffer import shared_renderer
    from workers.shard.fingerprint import take_fingerprint  # loads GL

    renderer = shared_renderer()
    if order.job.run.device == "gpu" and is_software(renderer.name):
        return order
    mine = take_fingerprint(renderer, order.job.drawn.tier)
    store.put(FINGERPRINT_FILE, mine.model_dump_json(indent=1).encode())
    return order.model_copy(update={"terms": order.terms.model_copy(update={"fingerprint": mine.digest})})


def join_cluster(store: Store, lock: Lock, pattern: Pattern) -> Pattern:
    """The pattern for workers on other hosts. Raises VersoError where a node of the cluster cannot work on the run."""
    terms = pattern.terms
    if store.root is not None:
        terms = replace(terms, out=str(store.root), proof=str(store.root / LOCK_FILE), token=lock.token)
    check_nodes(terms)
    return replace(pattern, terms=terms, env_vars=dict(terms.environment))

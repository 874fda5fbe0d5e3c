"""What a driver brings to its workers: its environment, its code, its stack, and the proof of its output folder. Edge."""

import os
import socket
from dataclasses import replace

from schemas.dataset.layout import FINGERPRINT_FILE, LOCK_FILE
from schemas.dataset.shard import ShardOrder
from services.run.lock import Lock
from services.run.node_probe import check_nodes
from services.run.pattern import Pattern
from services.run.worker_terms import WorkerTerms, worker_environment
from workers.pipeline.code import code_digest
from workers.store.store import Store


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
    from workers.pipeline.fingerprint import take_fingerprint  # loads GL
    from workers.render.raster.context import is_software
    from workers.render.raster.gbuffer import shared_renderer

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

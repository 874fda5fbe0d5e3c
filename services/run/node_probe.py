"""Asks every node of a cluster what it sees, before the first scene. Edge: Ray.

The question travels whole, so that a node without this project can answer, and it comes without the run's environment, so
that a processor that cannot have it is told instead of crashed.
"""

import time
from dataclasses import asdict

import ray
from ray import cloudpickle
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from services.run import sight
from services.run.progress import say
from services.run.worker_terms import WorkerTerms, refusal_of

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


def _ask(nodes: list[str], terms: WorkerTerms) -> list[sight.Sight]:
    """What the nodes see, in their order; those that do not answer are said and left out."""

    def look(proof: str, token: str) -> dict:
        return asdict(sight.see((), proof, token))

    cloudpickle.register_pickle_by_value(sight)
    try:
        task = ray.remote(num_cpus=0, max_retries=0)(look)
        asked = [
            task.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(
                terms.proof, terms.token
            )
            for node in nodes
        ]
    finally:
        cloudpickle.unregister_pickle_by_value(sight)
    seen, deadline = [], time.monotonic() + ANSWER_S
    for node, answer in zip(nodes, asked, strict=True):
        try:
            seen.append(sight.Sight(**ray.get(answer, timeout=max(0.1, deadline - time.monotonic()))))
        except RayError as error:
            say(
                f"node {node[:12]} does not say what it has ({type(error).__name__}): its workers are asked before they begin"
            )
    return seen

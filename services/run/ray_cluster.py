"""The Ray that runs the work: a private one on this machine, or a running cluster; its slots, and what its nodes must have.

A private Ray listens on loopback alone, answers who shows its token, and leaves nothing. On a cluster the slots change as
nodes come and go. Its nodes are asked what they have before the first scene: the question travels whole, so that a node
without this project can answer, and it comes without the run's environment, so that a processor that cannot have it is told
instead of crashed.
"""

import contextlib
import math
import os
import secrets
import shutil
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import ray
from ray import cloudpickle
from ray._private import ray_constants, utils
from ray._private.node import Node
from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from schemas.dataset.layout import FINGERPRINT_FILE, LOCK_FILE
from schemas.dataset.shard import ShardOrder
from schemas.errors import MachineError
from schemas.job.job import Run
from services.run import worker_entry
from services.run.machine import private_folder, usable_cores
from services.run.progress import say
from services.run.supervisor import core_stderr, tell
from services.run.worker_entry import Pattern, WorkerTerms, refusal_of
from workers.store.store import Store

PREFETCH = 2
"""Shards given to Ray for each slot: one that runs and one that waits, so that no slot is idle between two."""

LOOK_EVERY_S = 2.0
"""How often a cluster is asked for its cores, or its nodes."""


@dataclass(frozen=True)
class Slots:
    """The number of shards that run at once, and that may be given to Ray at once; `look` tells them where they change."""

    running: int
    in_flight: int
    look: "Callable[[], Slots] | None" = None

    def now(self) -> "Slots":
        """The slots at this moment."""
        return self.look() if self.look else self


def slots_of(cores: int, workers: int | None, jobs: int = 1) -> Slots:
    """The slots of a cluster with that many cores, at least one: `workers` where that is less; an even share of several jobs.

    Any free core would start a waiting shard, so none may wait where there are fewer workers than cores, or other jobs.
    """
    cores = max(1, cores)
    running = math.ceil(min(workers or cores, cores) / max(1, jobs))
    alone = jobs <= 1 and running == cores
    return Slots(running, PREFETCH * running if alone else running)


def cluster_slots(count_cores: Callable[[], int], workers: int | None, count_jobs: Callable[[], int]) -> Slots:
    """The slots of a cluster, at least one also while it has no node; `count_cores` is asked every few seconds."""
    cores, at_s = count_cores(), time.monotonic()

    def look() -> Slots:
        nonlocal cores, at_s
        if time.monotonic() - at_s >= LOOK_EVERY_S:
            cores, at_s = count_cores(), time.monotonic()
        return slots_of(cores, workers, count_jobs())

    return replace(look(), look=look)


RAY_PARTS = 10_000
"""Ray counts parts of a resource in so many steps. Rounded down, all parts of a GPU fit."""


def share_gpus(resources: Iterable[Mapping[str, float]], running: int, run: Run) -> float:
    """The part of a GPU that a shard asks for: by what each node has, shards that run at once, and the job.

    By default as few workers have a GPU together as leave no shard waiting: Ray fills one GPU before it takes the next.
    0 where no node has one, and where some have none and the job takes any device: those would stand idle.
    """
    working = [(int(node["CPU"]), int(node.get("GPU", 0))) for node in resources if node.get("CPU")]
    with_gpu = [(cores, gpus) for cores, gpus in working if gpus > 0]
    if not with_gpu or (run.device == "any" and len(with_gpu) < len(working)):
        return 0.0
    wanted = min(running, sum(cores for cores, _ in with_gpu))
    fewest = next(k for k in range(1, wanted + 1) if sum(min(cores, k * gpus) for cores, gpus in with_gpu) >= wanted)
    return RAY_PARTS // (run.workers_per_gpu or fewest) / RAY_PARTS


def alive_nodes() -> list[dict[str, Any]]:
    """The nodes of the Ray that this process is connected to, as Ray describes them."""
    return [node for node in ray.nodes() if node["Alive"]]


def private_environment() -> dict[str, str | None]:
    """The variables that every process of one private Ray starts with, None for those of the user's that it must not see.

    Each call makes a new token.
    """
    return {
        # Who does not show the token is refused. The mode is said outright: left open, Ray takes a token from the home
        # folder, or leaves one there; and another variable could have it ask Kubernetes who the caller is.
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_ENABLE_K8S_TOKEN_AUTH": "false",
        # No cluster, so this node's address is loopback, and every process binds to that. Otherwise Ray replaces
        # 127.0.0.1 by the machine's own address, and most of its processes listen on all of them.
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        "RAY_USAGE_STATS_ENABLED": "0",
        # A GCS of this machine that is gone does not come back, as a cluster's may: its clients end after this time, which
        # is 60 s otherwise. So do the agents of a Ray whose other processes were killed.
        "RAY_gcs_rpc_server_reconnect_timeout_s": "15",
        "RAY_REDIS_ADDRESS": None,  # would tie it to another one
    }


OBJECT_STORE_BYTES = 128 * 2**20
"""Images never cross Ray, so its shared memory can be small."""

CONNECT_S = 10.0
"""Time for a cluster's head to accept a connection."""


def open_ray(
    address: str | None, workers: int | None, sharing: Callable[[], int] | None = None
) -> contextlib.AbstractContextManager[Slots]:
    """The cluster at `address`, shared with so many jobs, or a private Ray, by default with a worker for each usable core."""
    return private_ray(workers or usable_cores()) if address is None else cluster_ray(address, workers, sharing)


@contextlib.contextmanager
def private_ray(workers: int) -> Iterator[Slots]:
    """A private Ray with `workers` slots, shut down when the block ends. Raises MachineError where Ray does not start.

    It never joins another Ray on this machine, contacts no other host, and has a token that no file and no log holds.
    """
    with private_folder() as folder, ray_in(folder, workers) as slots:
        yield slots


@contextlib.contextmanager
def ray_in(folder: Path, workers: int) -> Iterator[Slots]:
    """The same, in a private folder."""
    shared = Path("/dev/shm")
    # A container often has 64 MiB of shared memory only. In a folder Ray warns of slow storage, which reports can bear.
    roomy = shared.exists() and shutil.disk_usage(shared).free > 2 * OBJECT_STORE_BYTES
    settings = {
        "num_cpus": workers,
        "include_dashboard": False,
        "object_store_memory": OBJECT_STORE_BYTES,
        "_temp_dir": str(folder),
        "_plasma_directory": str(shared if roomy else folder),
        "_node_ip_address": "127.0.0.1",
        "_system_config": {"enable_metrics_collection": False},  # they would be served without asking for the token
    }
    with kept_private(), contextlib.ExitStack() as stack:
        tell(folder=str(folder.parent))  # the supervisor removes it where this process cannot
        try:
            stack.enter_context(connection("local", **settings))
        except Exception as error:  # Ray raises plain ones, after half a minute where the machine is overloaded
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise MachineError(
                f"Ray did not start on this machine ({reason}): see `verso doctor`, or start again when less is running here"
            ) from error
        yield Slots(workers, PREFETCH * workers)


@contextlib.contextmanager
def kept_private() -> Iterator[None]:
    """Makes Ray's next start in this process a private one; afterwards the user's own settings count again.

    `ray.init` has no setting that keeps these from starting:

    - the dashboard's process, which is there without a dashboard too, for usage statistics alone. It asks the metadata
      services of three clouds, even where the statistics are off;
    - the autoscaler and the log monitor, which have nothing to do here. The first serves metrics to anyone;
    - the servers of its agent, through which jobs are submitted. Without the dashboard's packages the agent has none;
    - the note in /tmp/ray of a cluster's address, by which any `ray.init()` on this machine would join it.
    """
    environ = os.environ  # noqa: TID251 - Ray and its processes read these settings nowhere else
    mine = private_environment()
    before = {name: environ.get(name) for name in mine}
    replacements: list[tuple[Any, str, Any]] = [
        (ray_constants, "ENABLE_RAY_CLUSTER", False),  # read from the environment when Ray was imported
        (Node, "start_api_server", _note_that_there_is_no_dashboard),
        (Node, "start_monitor", lambda node: None),
        (Node, "start_log_monitor", lambda node: None),
        (utils, "write_ray_address", lambda address, folder=None: None),
        (utils, "get_dashboard_dependency_error", lambda: ImportError("a private Ray has no dashboard")),
    ]
    with contextlib.ExitStack() as undo:
        undo.callback(_read_authentication_again)
        undo.callback(_set_variables, environ, before)
        _set_variables(environ, mine)
        for module, name, value in replacements:
            undo.callback(setattr, module, name, getattr(module, name))
            setattr(module, name, value)
        _read_authentication_again()
        yield


def _note_that_there_is_no_dashboard(node: Node, **_: Any) -> None:
    """Ray's agent would ask for the address every second."""
    node._webui_url = ""
    address, namespace = ray_constants.DASHBOARD_ADDRESS, ray_constants.KV_NAMESPACE_DASHBOARD
    node.get_gcs_client().internal_kv_put(address.encode(), b"none", True, namespace)


def _set_variables(environ: MutableMapping[str, str], values: Mapping[str, str | None]) -> None:
    """Sets the variables, and removes those whose value is None."""
    for name, value in values.items():
        if value is None:
            environ.pop(name, None)
        else:
            environ[name] = value


def _read_authentication_again() -> None:
    """Ray's core keeps the mode from its import, and the token from its first use."""
    Config.initialize("")
    AuthenticationTokenLoader.instance().reset_cache()


def address_here() -> str:
    """HOST:PORT of the Ray that this process is connected to."""
    return str(ray.get_runtime_context().gcs_address)


@contextlib.contextmanager
def cluster_ray(address: str, workers: int | None, sharing: Callable[[], int] | None = None) -> Iterator[Slots]:
    """A running cluster: as many slots as it has cores at the moment, or `workers` where that is less, shared by jobs.

    The user's own settings of authentication (RAY_AUTH_MODE, RAY_AUTH_TOKEN) count. Raises MachineError where no Ray
    answers at the address, or where it wants another token.
    """
    require_answer(address)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(connection(address))
        except (ConnectionError, RuntimeError, ValueError, RayError) as error:
            raise MachineError(
                f"--address {address}: {' '.join(str(error).split())}; a cluster that asks for a token needs "
                "RAY_AUTH_MODE=token and its RAY_AUTH_TOKEN here too"
            ) from error
        if _count_cores() < 1:
            raise MachineError(f"--address {address}: the cluster has no CPU to run on")
        yield cluster_slots(_count_cores, workers, sharing or (lambda: 1))


def _count_cores() -> int:
    return int(ray.cluster_resources().get("CPU", 0))


@contextlib.contextmanager
def connection(address: str, **settings: Any) -> Iterator[None]:
    """A connection to a Ray, shut down when the block ends.

    Ray's messages about dead workers go where its C++ core writes (to the user, or to a supervisor, which keeps them for
    the logs): standard output is for the command's answer. Ray puts the current folder first on its workers' search path. It
    is the project's for that moment: a `services` folder in the user's working folder must not be found instead.
    """
    with core_stderr() as stream, contextlib.redirect_stdout(stream):
        # While it starts, Ray asks Python to dump its stack to standard error where it crashes.
        with contextlib.chdir(Path(__file__).resolve().parents[2]), contextlib.redirect_stderr(stream):
            ray.init(address=address, log_to_driver=False, configure_logging=False, **settings)
        try:
            yield
        finally:
            ray.shutdown()


def require_answer(address: str | None) -> None:
    """Raises MachineError unless something accepts a connection; Ray itself would wait for a minute."""
    if address in (None, "auto"):
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or "://" in host:
        raise MachineError(
            f"--address {address}: write it as HOST:PORT, as `ray start` prints it (port 6379 by default)"
        )
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except OSError as error:
        raise MachineError(
            f"--address {address}: no Ray answers there ({error.strerror or error}); start one with `ray start --head`, or "
            "leave --address out to run on this machine"
        ) from error


# ------------------------------------------------------------------------------------------------ who may work

ANSWER_S = 60.0
"""Time for a node's answer: it may have to start a process for it. One that is silent is asked again by its workers."""


def on_node(task: Any, node: str) -> Any:
    """A remote function that runs on the node with this id."""
    return task.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False))


def join_cluster(store: Store, token: str, pattern: Pattern) -> Pattern:
    """The pattern for workers on other hosts. Raises VersoError where a node of the cluster cannot work on the run.

    `token` is what the lock's file in the output folder holds.
    """
    terms = pattern.terms
    if store.root is not None:
        terms = replace(terms, out=str(store.root), proof=str(store.root / LOCK_FILE), token=token)
    check_nodes(terms)
    return replace(pattern, order=with_own_stack(store, pattern.order), terms=terms, env_vars=dict(terms.environment))


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


def check_nodes(terms: WorkerTerms) -> None:
    """Raises the refusal of the first node that cannot work on the run; nothing where the driver's node is the only one.

    A node that does not answer is said and left out.
    """
    nodes = [node["NodeID"] for node in alive_nodes() if node["Resources"].get("CPU")]
    if len(nodes) < 2:
        return
    deadline = time.monotonic() + ANSWER_S
    for node, answer in [(node, _ask(node, terms)) for node in nodes]:
        try:
            sight = worker_entry.Sight(**ray.get(answer, timeout=max(0.1, deadline - time.monotonic())))
        except RayError as error:
            say(
                f"node {node[:12]} does not say what it has ({type(error).__name__}): its workers are asked before they begin"
            )
            continue
        if (refusal := refusal_of(terms, sight)) is not None:
            raise refusal


def _ask(node: str, terms: WorkerTerms) -> ray.ObjectRef:
    """What the node will tell of itself."""

    def look(proof: str, token: str) -> dict:
        return asdict(worker_entry.see((), proof, token))

    cloudpickle.register_pickle_by_value(worker_entry)
    try:
        return on_node(ray.remote(num_cpus=0, max_retries=0)(look), node).remote(terms.proof, terms.token)
    finally:
        cloudpickle.unregister_pickle_by_value(worker_entry)

"""The Ray that runs the work: a private one on this machine, or a running cluster."""

import contextlib
import os
import shutil
import socket
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any

import ray
from ray._private import ray_constants, utils
from ray._private.node import Node
from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]
from ray.exceptions import RayError

from schemas.errors import MachineError
from services.run.cores import usable_cores
from services.run.ray_environment import NOT_INHERITED, private_environment
from services.run.ray_folder import private_folder
from services.run.slots import PREFETCH, ClusterSlots, Slots
from services.run.supervisor import core_stderr, tell

OBJECT_STORE_BYTES = 128 * 2**20
"""Images never cross Ray, so its shared memory can be small."""

CONNECT_S = 10.0
"""Time for a cluster's head to accept a connection."""


def open_ray(address: str | None, workers: int | None) -> contextlib.AbstractContextManager[Slots]:
    """The cluster at `address`, or a private Ray, by default with a worker for each usable core."""
    return private_ray(workers or usable_cores()) if address is None else cluster_ray(address, workers)


@contextlib.contextmanager
def private_ray(workers: int) -> Iterator[Slots]:
    """A private Ray with `workers` slots, shut down when the block ends.

    Never joins another Ray on this machine and contacts no other host. Its processes listen on loopback and on sockets in
    a folder that no other user can enter, and answer those that show its token, which no file and no log holds. Raises
    MachineError where Ray does not start.
    """
    with private_folder() as folder, kept_private():
        tell(folder=str(folder.parent))  # the supervisor removes it where this process cannot
        settings = {
            "num_cpus": workers,
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
            "_temp_dir": str(folder),
            "_plasma_directory": _object_store_folder(str(folder)),
            "_node_ip_address": "127.0.0.1",
            "_system_config": {"enable_metrics_collection": False},  # they would be served without asking for the token
        }
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(connection("local", **settings))
            except Exception as error:  # Ray raises plain ones, after half a minute where the machine is overloaded
                said = next(iter(str(error).splitlines()), type(error).__name__)
                raise MachineError(
                    f"Ray did not start on this machine ({said}): see `verso doctor`, or start again when less is running here"
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
    before = {name: environ.get(name) for name in (*mine, *NOT_INHERITED)}
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
        _set_variables(environ, {**dict.fromkeys(NOT_INHERITED), **mine})
        for module, name, value in replacements:
            undo.callback(setattr, module, name, getattr(module, name))
            setattr(module, name, value)
        _read_authentication_again()
        yield


def _note_that_there_is_no_dashboard(node: Node, **_: Any) -> None:
    """What the dashboard's process does where it serves nothing; Ray's agent would ask for the address every second."""
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


def _object_store_folder(temporary: str) -> str:
    """Shared memory where there is enough of it, otherwise the temporary folder.

    A container often has 64 MiB only. Ray then warns of slow storage, which does not matter for reports of a kilobyte.
    """
    shared = Path("/dev/shm")
    roomy = shared.exists() and shutil.disk_usage(shared).free > 2 * OBJECT_STORE_BYTES
    return str(shared) if roomy else temporary


@contextlib.contextmanager
def cluster_ray(address: str, workers: int | None) -> Iterator[Slots]:
    """A running cluster: as many slots as it has cores at the moment, or `workers` where that is less.

    The user's own settings of authentication (RAY_AUTH_MODE, RAY_AUTH_TOKEN) count. Raises MachineError where no Ray
    answers at the address, or where it wants another token.
    """
    _check_reachable(address)
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
        yield ClusterSlots.of(_count_cores, workers)


def _count_cores() -> int:
    return int(ray.cluster_resources().get("CPU", 0))


@contextlib.contextmanager
def connection(address: str, **settings: Any) -> Iterator[None]:
    """A connection to a Ray, shut down when the block ends.

    Ray's messages about dead workers go where its C++ core writes (to the user, or to a supervisor, which keeps them for
    the logs), because standard output is for the command's answer, and what they mean is told by us. Ray puts the
    current folder first on its workers' search path. It is the project's for that moment, because the packages have
    generic names: a `services` folder in the user's working folder must not be found instead.
    """
    with core_stderr() as stream, contextlib.redirect_stdout(stream):
        # While it starts, Ray asks Python to dump its stack to standard error where it crashes.
        with contextlib.chdir(Path(__file__).resolve().parents[2]), contextlib.redirect_stderr(stream):
            ray.init(address=address, log_to_driver=False, configure_logging=False, **settings)
        try:
            yield
        finally:
            ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises MachineError unless something accepts a connection; Ray itself would wait for a minute."""
    if address == "auto":
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

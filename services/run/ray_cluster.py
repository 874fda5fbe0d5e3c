"""The Ray that runs the work: a private one on this machine, or a running cluster."""

import contextlib
import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray

from schemas.errors import MachineError
from services.run.cores import usable_cores
from services.run.supervisor import tell

OBJECT_STORE_BYTES = 128 * 2**20
"""Images never cross Ray, so its shared memory can be small."""

CONNECT_S = 10.0
"""Time for a cluster's head to accept a connection."""

PREFETCH = 2
"""Shards given to Ray for each slot: one that runs and one that waits, so that no slot is idle between two."""


@dataclass(frozen=True)
class Slots:
    """The number of shards that run at once, and that may be given to Ray at once."""

    running: int
    in_flight: int


def open_ray(address: str | None, workers: int | None) -> contextlib.AbstractContextManager[Slots]:
    """The cluster at `address`, or a private Ray, by default with a worker for each usable core."""
    return private_ray(workers or usable_cores()) if address is None else cluster_ray(address, workers)


@contextlib.contextmanager
def private_ray(workers: int) -> Iterator[Slots]:
    """A private Ray with `workers` slots, shut down when the block ends.

    Never joins another Ray on this machine, contacts no other host and opens no dashboard.
    """
    # Otherwise Ray asks its own workers for a token that an earlier Ray left in the home folder.
    os.environ["RAY_AUTH_MODE"] = "disabled"  # noqa: TID251 - Ray reads this setting nowhere else
    with tempfile.TemporaryDirectory(prefix="vr", ignore_cleanup_errors=True) as folder:
        tell(folder=folder)  # the supervisor removes it where this process cannot
        settings = {
            "num_cpus": workers,
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
            "_temp_dir": folder,
            "_plasma_directory": _object_store_folder(folder),
            "_node_ip_address": "127.0.0.1",
        }
        with _connection("local", **settings):
            yield Slots(workers, PREFETCH * workers)


def _object_store_folder(temporary: str) -> str:
    """Shared memory where there is enough of it, otherwise the temporary folder.

    A container often has 64 MiB only. Ray then warns of slow storage, which does not matter for reports of a kilobyte.
    """
    shared = Path("/dev/shm")
    roomy = shared.exists() and shutil.disk_usage(shared).free > 2 * OBJECT_STORE_BYTES
    return str(shared) if roomy else temporary


@contextlib.contextmanager
def cluster_ray(address: str, workers: int | None) -> Iterator[Slots]:
    """A running cluster: as many slots as it has cores, or `workers` where that is less.

    Raises MachineError where no Ray answers at the address.
    """
    _check_reachable(address)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(_connection(address))
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise MachineError(f"--address {address}: {error}") from error
        cores = int(ray.cluster_resources().get("CPU", 0))
        if cores < 1:
            raise MachineError(f"--address {address}: the cluster has no CPU to run on")
        # Any free core would start a waiting shard, so none may wait where there are fewer workers than cores.
        yield Slots(workers, workers) if workers and workers < cores else Slots(cores, PREFETCH * cores)


@contextlib.contextmanager
def _connection(address: str, **settings: Any) -> Iterator[None]:
    """A connection to a Ray, shut down when the block ends.

    Ray's messages about dead workers go to standard error: standard output is for the command's answer. Ray puts the
    current folder first on its workers' search path. It is the project's for that moment, because the packages have
    generic names: a `services` folder in the user's working folder must not be found instead.
    """
    with contextlib.redirect_stdout(sys.stderr):
        with contextlib.chdir(Path(__file__).resolve().parents[2]):
            ray.init(address=address, log_to_driver=False, configure_logging=False, **settings)
        try:
            yield
        finally:
            ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises MachineError unless something accepts a connection; Ray itself would wait for a minute."""
    if address == "auto":
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
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

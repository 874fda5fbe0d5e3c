"""Where the work runs: a private Ray on this machine, or a cluster that is already there."""

import contextlib
import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import ray

from schemas.errors import MachineError

OBJECT_STORE_BYTES = 128 * 2**20
"""Images never cross Ray, so its shared memory can be small."""

ANSWER_S = 10.0
"""How long a cluster's head may take to accept a connection."""


PREFETCH = 2
"""Shards given to Ray for each slot: one that runs and one that waits, so that no slot idles between two."""


@dataclass(frozen=True)
class Slots:
    """How many shards run at once, and how many may be given to Ray at once."""

    running: int
    in_flight: int


@contextlib.contextmanager
def private_ray(workers: int) -> Iterator[Slots]:
    """A Ray of our own with `workers` slots, gone when the block ends.

    Never joins a Ray that happens to run on this machine, reaches out to nobody and opens no dashboard.
    """
    # A token that an earlier Ray left in the home folder would be asked of our own workers.
    os.environ["RAY_AUTH_MODE"] = "disabled"  # noqa: TID251 - Ray reads this setting nowhere else
    with _quiet_stdout(), tempfile.TemporaryDirectory(prefix="vr", ignore_cleanup_errors=True) as folder:
        with _project_first():
            ray.init(
                address="local",
                num_cpus=workers,
                include_dashboard=False,
                object_store_memory=OBJECT_STORE_BYTES,
                log_to_driver=False,
                configure_logging=False,
                _temp_dir=folder,
                _plasma_directory=_object_store_folder(folder),
                _node_ip_address="127.0.0.1",
            )
        with _shut_down():
            yield Slots(workers, PREFETCH * workers)


def _object_store_folder(temporary: str) -> str:
    """Shared memory where there is enough of it.

    A container often has 64 MiB, and Ray then warns of slow storage, which is of no matter to reports of a kilobyte.
    """
    shared = Path("/dev/shm")
    roomy = shared.exists() and shutil.disk_usage(shared).free > 2 * OBJECT_STORE_BYTES
    return str(shared) if roomy else temporary


@contextlib.contextmanager
def cluster_ray(address: str, workers: int | None) -> Iterator[Slots]:
    """A cluster that runs already: as many slots as it has cores, or `workers` where that is less.

    Raises MachineError where nobody answers at the address.
    """
    _probe(address)
    with _quiet_stdout():
        try:
            with _project_first():
                ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise MachineError(f"--address {address}: {error}") from error
        with _shut_down():
            yield _cluster_slots(address, workers)


def _cluster_slots(address: str, workers: int | None) -> Slots:
    cores = int(ray.cluster_resources().get("CPU", 0))
    if cores < 1:
        raise MachineError(f"--address {address}: the cluster has no CPU to run on")
    # A shard that waits could be started by any free core, so fewer workers than cores means none that waits.
    return Slots(workers, workers) if workers and workers < cores else Slots(cores, PREFETCH * cores)


@contextlib.contextmanager
def _shut_down() -> Iterator[None]:
    try:
        yield
    finally:
        ray.shutdown()


def _quiet_stdout() -> contextlib.AbstractContextManager[object]:
    """Ray tells of dead workers on the driver's standard output, which belongs to the command's answer."""
    return contextlib.redirect_stdout(sys.stderr)


@contextlib.contextmanager
def _project_first() -> Iterator[None]:
    """Ray puts the folder that its driver stands in first on its workers' search path: let that be ours.

    The packages have generic names; a `services` folder where the user happens to stand must not be found instead.
    """
    before = Path.cwd()
    os.chdir(Path(__file__).resolve().parents[2])
    try:
        yield
    finally:
        os.chdir(before)


def _probe(address: str) -> None:
    """Raises MachineError unless something accepts a connection; Ray itself would wait for a minute."""
    if address == "auto":
        return
    plain = address.removeprefix("ray://")
    host, _, port = plain.rpartition(":")
    if not host or not port.isdigit():
        raise MachineError(
            f"--address {address}: write it as HOST:PORT, as `ray start` prints it (port 6379 by default)"
        )
    try:
        socket.create_connection((host, int(port)), timeout=ANSWER_S).close()
    except OSError as error:
        raise MachineError(
            f"--address {address}: no Ray answers there ({error.strerror or error}); start one with `ray start --head`, or "
            "leave --address out to run on this machine"
        ) from error

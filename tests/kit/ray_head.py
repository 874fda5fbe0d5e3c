"""Ray clusters on loopback, as `ray start --head` makes them: one with job API and token, one as started in a bare shell."""

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from schemas.environment import cache_folder
from tests.kit.killed_runs import processes_with
from tests.kit.network import free_port, free_ports

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class RayHead:
    """A head that runs: the address of its job API, and the environment of its processes, for its users too."""

    http: str
    environment: Mapping[str, str]
    mark: str


@contextlib.contextmanager
def ray_head(cores: int) -> Iterator[RayHead]:
    """A head with so many cores; everything that it or its jobs started is ended when the block ends."""
    folder = Path(tempfile.mkdtemp(prefix="vh", dir="/tmp"))  # a short name, because sockets lie in it
    mark = f"VERSO_TEST_MARK={uuid.uuid4().hex}"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    environment |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0"}
    environment |= {"PYTHONPATH": str(ROOT), "HOME": str(folder), **dict([mark.split("=")])}
    environment["NUMBA_CACHE_DIR"] = str(cache_folder("loops"))  # a new home has no compiled loops
    gcs, http, client, agent, agent_grpc = free_ports(5)
    ports = {"port": gcs, "dashboard-port": http, "ray-client-server-port": client}
    ports |= {"dashboard-agent-listen-port": agent, "dashboard-agent-grpc-port": agent_grpc}
    command = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", "--node-ip-address=127.0.0.1"]
    command += ["--dashboard-host=127.0.0.1", "--include-dashboard=true", f"--num-cpus={cores}"]
    command += [f"--temp-dir={folder}/r", "--object-store-memory=134217728", *(f"--{k}={v}" for k, v in ports.items())]
    with (folder / "head.log").open("wb") as log:
        started = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True)
    try:
        head = RayHead(f"http://127.0.0.1:{http}", environment, mark)
        _wait_until_it_answers(head, folder / "head.log")
        yield head
    finally:
        while left := processes_with(mark):
            for process in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGKILL)
            time.sleep(0.2)
        started.wait()
        shutil.rmtree(folder, ignore_errors=True)


def _wait_until_it_answers(head: RayHead, log: Path, patience_s: float = 90.0) -> None:
    asked = urllib.request.Request(
        f"{head.http}/api/jobs/", headers={"Authorization": f"Bearer {head.environment['RAY_AUTH_TOKEN']}"}
    )
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError), urllib.request.urlopen(asked, timeout=5):
            return
        time.sleep(0.3)
    raise TimeoutError(f"Ray's job API did not answer in {patience_s} s: {log.read_text()[-2000:]}")


RAY = str(Path(sys.executable).with_name("ray"))


@dataclass(frozen=True)
class BareCluster:
    """Its address, the address of its dashboard, and the variables of a shell on its head."""

    address: str
    dashboard: str
    shell: dict[str, str]

    def verso(self, *words: str, **more: str) -> "subprocess.CompletedProcess[str]":
        """A command of this project in that shell."""
        command = [sys.executable, "-P", "-m", "services.cli.main", *words]
        environ = {**self.shell, **more}
        return subprocess.run(command, cwd="/", env=environ, capture_output=True, text=True, check=False, timeout=280)


@contextlib.contextmanager
def bare_cluster(cores: int = 2, dashboard: bool = False) -> Iterator[BareCluster]:
    """One node with that many cores, which asks for a token; all of its processes end with the block."""
    with tempfile.TemporaryDirectory(prefix="bare-", dir="/tmp") as folder:
        shell = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": os.environ["HOME"]}
        shell |= {
            "PYTHONPATH": str(ROOT),
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
        }
        port, jobs = free_port(), free_port()
        start = [
            RAY,
            "start",
            "--head",
            "--block",
            "--node-ip-address=127.0.0.1",
            f"--port={port}",
            f"--num-cpus={cores}",
        ]
        start += [f"--temp-dir={folder}/r", f"--include-dashboard={str(dashboard).lower()}"]
        start += ["--dashboard-host=127.0.0.1", f"--dashboard-port={jobs}"]
        start += [f"--dashboard-agent-listen-port={free_port()}"]
        with _node(start, Path(folder, "head.log"), shell):
            yield BareCluster(f"127.0.0.1:{port}", f"http://127.0.0.1:{jobs}", shell)


@contextlib.contextmanager
def another_node(cluster: BareCluster, folder: Path, *before: str) -> Iterator[None]:
    """A second node with one core joins; `before` are the words of a command that enters it, such as a namespace."""
    address = f"--address={cluster.address}"
    start = [*before, RAY, "start", "--block", address, "--node-ip-address=127.0.0.1", "--num-cpus=1"]
    start += [f"--dashboard-agent-listen-port={free_port()}"]
    with _node(start, folder / "node.log", cluster.shell):
        yield


@contextlib.contextmanager
def _node(start: list[str], log: Path, shell: dict[str, str]) -> Iterator[None]:
    start = [*start, "--disable-usage-stats", "--object-store-memory=100000000"]
    with open(log, "wb") as said:
        node = subprocess.Popen(start, cwd="/", env=shell, stdout=said, stderr=said, stdin=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while b"Ray runtime started" not in log.read_bytes():
            if node.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"Ray did not start: {log.read_text()[-2000:]}")
            time.sleep(0.1)
        yield
    finally:
        node.terminate()  # it ends the processes that it started
        node.wait(60)

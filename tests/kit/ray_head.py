"""Ray clusters on loopback, as `ray start --head` makes them in a bare shell, with a token."""

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.kit.killed_runs import processes_with
from tests.kit.network import free_port, free_ports

ROOT = Path(__file__).resolve().parents[2]


RAY = str(Path(sys.executable).with_name("ray"))


@dataclass(frozen=True)
class BareCluster:
    """Its address, that of its dashboard with the job API, the variables of a shell on its head, and a mark among these."""

    address: str
    dashboard: str
    shell: dict[str, str]
    mark: str

    def verso(self, *words: str, **more: str) -> "subprocess.CompletedProcess[str]":
        """A command of this project in that shell."""
        command = [sys.executable, "-P", "-m", "services.cli.main", *words]
        environ = {**self.shell, **more}
        return subprocess.run(command, cwd="/", env=environ, capture_output=True, text=True, check=False, timeout=280)


@contextlib.contextmanager
def bare_cluster(cores: int = 2, dashboard: bool = False) -> Iterator[BareCluster]:
    """One node with that many cores, which asks for a token; all that it or its jobs started is ended with the block."""
    mark = f"VERSO_TEST_MARK={uuid.uuid4().hex}"
    shell = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": os.environ["HOME"]}
    shell |= {"PYTHONPATH": str(ROOT), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    shell |= dict([mark.split("=")])
    gcs, http, client, agent, agent_grpc = free_ports(5)
    ports = {"port": gcs, "dashboard-port": http, "ray-client-server-port": client}
    ports |= {"dashboard-agent-listen-port": agent, "dashboard-agent-grpc-port": agent_grpc}
    start = [RAY, "start", "--head", "--block", "--node-ip-address=127.0.0.1", f"--num-cpus={cores}"]
    start += ["--dashboard-host=127.0.0.1", f"--include-dashboard={str(dashboard).lower()}"]
    start += [f"--{name}={port}" for name, port in ports.items()]
    folder = Path(tempfile.mkdtemp(prefix="bare-", dir="/tmp"))  # a short name, because sockets lie in it
    try:
        with _node([*start, f"--temp-dir={folder}/r"], folder / "head.log", shell):
            yield BareCluster(f"127.0.0.1:{gcs}", f"http://127.0.0.1:{http}", shell, mark)
    finally:
        while left := processes_with(mark):
            for process in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGKILL)
            time.sleep(0.2)
        shutil.rmtree(folder, ignore_errors=True)


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

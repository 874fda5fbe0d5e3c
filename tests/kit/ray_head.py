"""A Ray cluster on loopback as `ray start --head` makes it in a bare shell: with a token, and with job API where asked for."""

import contextlib
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.kit.killed_runs import processes_with
from tests.kit.network import free_port, free_ports

ROOT = Path(__file__).resolve().parents[2]
RAY = str(Path(sys.executable).with_name("ray"))
VERSO = (sys.executable, "-P", "-m", "services.cli.main")


@dataclass(frozen=True)
class BareCluster:
    """Its address, that of its dashboard, the variables of a shell on its head, and the one that marks its processes."""

    address: str
    dashboard: str
    shell: dict[str, str]
    mark: str

    def verso(self, *words: str, **more: str) -> "subprocess.CompletedProcess[str]":
        """A command of this project in that shell."""
        environ = {**self.shell, **more}
        return subprocess.run(
            [*VERSO, *words], cwd="/", env=environ, capture_output=True, text=True, check=False, timeout=280
        )


@contextlib.contextmanager
def bare_cluster(cores: int = 2, dashboard: bool = False) -> Iterator[BareCluster]:
    """One node with that many cores, which asks for a token; all of its processes and its jobs' end with the block."""
    with tempfile.TemporaryDirectory(prefix="bare-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        mark, token = f"VERSO_TEST_MARK={uuid.uuid4().hex}", secrets.token_hex(32)
        shell = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": os.environ["HOME"]}
        shell |= {"PYTHONPATH": str(ROOT), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token, **dict([mark.split("=")])}
        port, jobs, client, agent = free_ports(4)
        start = [RAY, "start", "--head", "--block", "--node-ip-address=127.0.0.1", f"--port={port}"]
        start += [f"--num-cpus={cores}", f"--temp-dir={folder}/r", f"--ray-client-server-port={client}"]
        start += [f"--include-dashboard={str(dashboard).lower()}", "--dashboard-host=127.0.0.1"]
        start += [f"--dashboard-port={jobs}", f"--dashboard-agent-listen-port={agent}"]
        cluster = BareCluster(f"127.0.0.1:{port}", f"http://127.0.0.1:{jobs}", shell, mark)
        try:
            with _node(start, Path(folder, "head.log"), shell):
                if dashboard:
                    _wait_for_jobs(cluster)
                yield cluster
        finally:
            while left := processes_with(mark):
                for process in left:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(process.pid, signal.SIGKILL)
                time.sleep(0.2)


def _wait_for_jobs(cluster: BareCluster) -> None:
    allowed = {"Authorization": f"Bearer {cluster.shell['RAY_AUTH_TOKEN']}"}
    for _ in range(300):
        asked = urllib.request.Request(f"{cluster.dashboard}/api/jobs/", headers=allowed)
        with contextlib.suppress(OSError), urllib.request.urlopen(asked, timeout=5):
            return
        time.sleep(0.3)
    raise TimeoutError("Ray's job API did not answer")


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
    start = [*start, "--disable-usage-stats", "--object-store-memory=134217728"]
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

"""A Ray cluster on this machine that was started without any of this project's variables, as by hand in a bare shell."""

import contextlib
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[1]
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
        shell |= {"PYTHONPATH": str(ROOT), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
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

"""A Ray head of its own on loopback, with job API and token, as `ray start --head` makes it."""

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

from tests.killed_runs import processes_with
from tests.ports import free_ports

ROOT = Path(__file__).resolve().parents[1]


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

"""A real run on a host of its own: who can reach it, from outside and from beside it, and what it sends.

What listens is asked of the kernel on every machine in test_ray_cluster.py; this needs root, for the network.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.kit.network import (
    HOST_LAN,
    Listener,
    Network,
    NoNamespacesError,
    listeners_of,
    open_ports,
    private_network,
    tree_of,
    unix_sockets_of,
)

pytestmark = [pytest.mark.root, pytest.mark.ray, pytest.mark.timeout(600)]

ROOT = Path(__file__).resolve().parents[3]
JOB = ROOT / "deploy" / "jobs" / "tabletop.yaml"
AGENT_PORT = 52365
"""Where Ray's agent takes jobs by default."""


def command(out: Path) -> list[str]:
    options = ["--scenes", "8", "--workers", "2", "--shard-size", "4", "--set", "run.range_size=4", "--json"]
    return [sys.executable, "-m", "services.cli.main", "run", str(JOB), "--out", str(out), *options]


def digest(told: str) -> str:
    return json.loads(told.splitlines()[-1])["digest"]


@dataclass
class Attack:
    """What a run on a host of its own let happen."""

    digest: str
    listeners: set[Listener]
    unix_sockets: set[tuple[str, str]]
    modes: dict[str, int]
    """Of the folders above the sockets."""
    reached: list[int]
    """Ports that accepted the attacker's connection."""
    answers: dict[str, dict[str, str]]
    """By port and call: what a local process without the token was told."""
    frames: list[str]
    injected: bool


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> Iterator[Network]:
    try:
        with private_network(tmp_path_factory.mktemp("network")) as network:
            yield network
    except NoNamespacesError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def attack(network, tmp_path_factory) -> Attack:
    folder = tmp_path_factory.mktemp("attack")
    victim = folder / "victim"
    with network.watch() as frames:
        run = subprocess.Popen(
            network.command(command(folder / "out")),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        attacker = [sys.executable, str(ROOT / "tests" / "kit" / "callers_without_token.py"), f"touch {victim}"]
        caller = subprocess.Popen(
            network.command(attacker),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={name: value for name, value in os.environ.items() if not name.startswith("RAY_")},
        )
        over, seen = threading.Event(), (set[Listener](), set[tuple[str, str]]())
        observer = threading.Thread(target=observe, args=(run.pid, over, seen))
        observer.start()
        try:
            listeners = wait_for_workers(run)
            folders = {folder for _, name in unix_sockets_of(run.pid) for folder in above(name)}
            modes = {folder: os.stat(folder).st_mode & 0o777 for folder in folders}
            answers = json.loads(caller.communicate(json.dumps(sorted({one.port for one in listeners})) + "\n")[0])
            reached = network.from_outside(lambda: scan(run))
            told, errors = run.communicate(timeout=300)
        finally:
            over.set()
            observer.join()
            for process in (run, caller):
                if process.poll() is None:
                    process.kill()
    assert run.returncode == 0, errors
    return Attack(digest(told), *seen, modes, reached, answers, list(frames), victim.exists())


def observe(root: int, over: threading.Event, seen: tuple[set[Listener], set[tuple[str, str]]]) -> None:
    """Collects what the run's processes listen on, from its start to its end."""
    while not over.wait(0.1):
        try:
            seen[0].update(listeners_of(root))
            seen[1].update(unix_sockets_of(root))
        except (FileNotFoundError, ProcessLookupError):
            return


def wait_for_workers(run: subprocess.Popen) -> set[Listener]:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and run.poll() is None:
        listeners = listeners_of(run.pid)
        if sum(is_worker(one) for one in listeners) >= 2:
            return listeners
        time.sleep(0.05)
    raise AssertionError(f"no two workers listen: {run.poll()}, {sorted(listeners_of(run.pid))}")


def is_worker(listener: Listener) -> bool:
    return listener.process.startswith("ray::") and "Agent" not in listener.process and "Env" not in listener.process


def scan(run: subprocess.Popen) -> list[int]:
    """Tries each port from outside, while the coordinator is held, so that nothing ends meanwhile."""
    ours = [pid for pid in tree_of(run.pid) if b"services.cli.main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    coordinator = ours[-1]  # below its supervisors
    os.kill(coordinator, signal.SIGSTOP)
    try:
        return open_ports(HOST_LAN, range(1, 65536))
    finally:
        os.kill(coordinator, signal.SIGCONT)


def above(socket_name: str) -> list[str]:
    return [str(folder) for folder in Path(socket_name).parents]


def test_nothing_answers_from_outside_and_nothing_is_sent(attack):
    assert attack.reached == []
    assert attack.frames == []


def test_every_process_listens_on_loopback_or_in_a_folder_that_no_other_user_enters(attack):
    processes = {one.process for one in attack.listeners}
    assert {"gcs_server", "raylet"} < processes and any(is_worker(one) for one in attack.listeners)
    assert [one for one in sorted(attack.listeners) if one.address not in ("127.0.0.1", "::1")] == []
    assert AGENT_PORT not in {one.port for one in attack.listeners}
    assert {name for name, _ in attack.unix_sockets} == {"raylet"}
    for _, name in attack.unix_sockets:
        assert any(attack.modes.get(folder) == 0o700 for folder in above(name)), name


def test_a_local_process_without_the_token_is_refused(attack):
    grpc_ports = http_ports = 0
    for port, calls in attack.answers.items():
        told = {call: answer for call, answer in calls.items() if answer not in ("UNIMPLEMENTED", "UNAVAILABLE")}
        grpc_ports += "UNAUTHENTICATED" in told.values()
        http_ports += any(answer.isdigit() for answer in told.values())
        allowed = {"401", "UNAUTHENTICATED", "BadStatusLine", "RemoteDisconnected", "ConnectionResetError"}
        assert set(told.values()) <= allowed, (port, told)
    assert grpc_ports >= 5, attack.answers  # GCS, the raylet's two, the coordinator, two workers
    assert http_ports >= 1, attack.answers  # the agent for environments
    assert not attack.injected


@pytest.mark.slow
def test_the_attack_changes_no_byte(attack, tmp_path):
    run = subprocess.run(command(tmp_path / "out"), cwd=ROOT, capture_output=True, text=True, check=True)
    assert digest(run.stdout) == attack.digest


def test_what_is_sent_would_be_seen(network):
    """The watch itself: a look-up of a name, and a metadata service that is asked."""
    ask = "import socket, contextlib\nfor host in ('metadata.google.internal', '169.254.169.254'):\n"
    ask += "    with contextlib.suppress(OSError):\n        socket.create_connection((host, 80), timeout=1)"
    with network.watch() as frames:
        before = len(frames)
        subprocess.run(network.command([sys.executable, "-c", ask]), check=True)
    told = set(frames[before:])
    assert {"UDP to 10.211.0.1:53", "TCP to 169.254.169.254:80"} <= told, told

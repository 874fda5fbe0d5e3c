"""A cluster of docker-compose.yml as users type it: workers that are killed, who can reach it, and what is left behind."""

import json
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.kit.containers import IMAGE, JOB, digest_in, docker, must, owner_of_checkouts, run, wait_for

pytestmark = [pytest.mark.docker, pytest.mark.slow, pytest.mark.timeout(900)]

SMALL_RANGES = ("--shard-size", "1", "--set", "run.range_size=2")

PORTS = (6379, 8265, 10001, 52365)
"""Of the GCS, the dashboard with its job API, Ray's client and the agent of each node."""


@pytest.fixture(scope="module")
def cluster(compose):
    """A head and three workers, one core each."""
    must(compose("up", "-d", "--scale", "worker=3", "head", "worker", VERSO_WORKER_CPUS="1"))
    names = [compose.container("worker", number) for number in (1, 2, 3)]
    # A worker that joins when the ranges are given away already gets none of them.
    wait_for(lambda: all(_health(name) == "healthy" for name in names), 180, "three healthy workers")
    return compose


def test_three_workers_make_the_same_bytes_also_where_one_is_told_to_leave(cluster, expected_digest):
    out = cluster.checkout / "data" / "three"
    names = {number: _name_of(cluster.container("worker", number)) for number in (1, 2, 3)}
    with ThreadPoolExecutor() as beside:
        job = beside.submit(cluster, "run", "--rm", "job", "run", JOB, "--out", "data/three", *SMALL_RANGES, "--json")
        # Workers need not be at work at the same moment: one may have ended its range before another begins.
        wait_for(lambda: set(names.values()) <= _begun(out) | _hosts(out), 240, "a range of each worker", every_s=0.02)
        begun = time.monotonic()
        must(docker("stop", "--time", "60", cluster.container("worker", 3)))
        assert time.monotonic() - begun < 30
        answer = must(job.result())
    assert must(docker("inspect", "--format", "{{.State.ExitCode}}", cluster.container("worker", 3))).strip() == "0"
    assert digest_in(answer) == expected_digest
    assert _hosts(out) == set(names.values())
    assert '"worker lost"' not in (out / "_logs" / "verso.jsonl").read_text()


def test_no_process_of_a_worker_has_a_capability_or_is_root(cluster):
    asks = "grep -H -E '^(Uid|CapEff|NoNewPrivs):' /proc/[0-9]*/status"
    rows = [line.split() for line in must(docker("exec", cluster.container("worker"), "sh", "-c", asks)).splitlines()]
    owner = str(owner_of_checkouts())
    unprivileged = {row[0].split("/")[2] for row in rows if row[0].endswith("Uid:") and row[1:] == [owner] * 4}
    assert len(unprivileged) > 4  # the node and its agents
    of_them = [row for row in rows if row[0].split("/")[2] in unprivileged]
    assert {row[1] for row in of_them if row[0].endswith("CapEff:")} == {"0000000000000000"}
    assert {row[1] for row in of_them if row[0].endswith("NoNewPrivs:")} == {"1"}
    others = [line for line in _commands(cluster.container("worker"), owner) if "/proc/[0-9]" not in line]
    assert [line.split()[0] for line in others] == ["/sbin/docker-init"]


def test_the_root_file_system_cannot_be_written(cluster):
    for place in ("/opt/verso/schemas", "/usr", "/var/tmp", "/run/verso"):
        done = docker("exec", cluster.container("worker"), "touch", f"{place}/x")
        assert "Read-only file system" in done.stderr, place


def test_containers_are_healthy_and_say_when_they_are_not(cluster):
    must(cluster("up", "-d", "--scale", "worker=3", "head", "worker", VERSO_WORKER_CPUS="1"))  # one was stopped
    names = [cluster.container("head"), *(cluster.container("worker", number) for number in (1, 2, 3))]
    wait_for(lambda: {_health(name) for name in names} == {"healthy"}, 60, "healthy containers")
    alone = docker("run", "--rm", IMAGE, "health")
    assert alone.returncode != 0


def test_only_who_has_the_token_is_answered(cluster):
    asks = ("ray", "status", "--address", "head:6379")
    worker = cluster.container("worker")
    assert "node_" in must(docker("exec", worker, *asks))
    for wrong in (("-e", "RAY_AUTH_TOKEN=wrong"), ("-e", "RAY_AUTH_MODE=disabled", "-e", "RAY_AUTH_TOKEN_PATH=")):
        refused = docker("exec", *wrong, worker, *asks)
        assert refused.returncode != 0
        assert "InvalidAuthToken" in refused.stderr
    token = must(docker("exec", worker, "cat", "/run/verso/token"))
    assert len(token) == 64
    listing = run("grep", "-rl", token, ".", cwd=cluster.checkout)
    assert listing.stdout == ""  # it is in no file


def test_no_port_can_be_reached_from_outside(cluster):
    network = json.loads(must(docker("network", "inspect", f"{cluster.project}_cluster")))[0]
    bridge = f"br-{network['Id'][:12]}"
    head = must(docker("exec", cluster.container("head"), "hostname", "-i")).strip()
    assert must(docker("ps", "--filter", f"name={cluster.project}", "--format", "{{.Ports}}")).split() == []
    # From within, the same looks find an open door: they can tell.
    within = must(docker("exec", cluster.container("worker"), "python", "-c", _looks(head, PORTS)))
    assert json.loads(within) == [6379, 10001, 52365]
    # This machine has no route there, and is not answered where it sends packets onto the bridge all the same.
    assert f"dev {bridge}" not in must(run("ip", "route", "get", head))
    for port in PORTS:
        assert not _answers(head, port, bridge)


def test_a_container_of_another_network_cannot_reach_it(cluster):
    head = must(docker("exec", cluster.container("head"), "hostname", "-i")).strip()
    other = f"{cluster.project}-other"
    must(docker("network", "create", "--internal", other))  # its packets stay on this machine
    try:
        looks = ("run", "--rm", "--network", other, "--entrypoint", "python", IMAGE, "-c", _looks(head, PORTS))
        assert json.loads(must(docker(*looks))) == []
    finally:
        docker("network", "rm", other)


def test_a_container_of_it_reaches_neither_this_machine_nor_others(cluster):
    here = _this_machine()
    with socket.create_server(("0.0.0.0", 0)) as server:
        port = server.getsockname()[1]
        looks = _looks(here, (port,))
        # From Docker's usual network it can be reached: the look can tell.
        assert json.loads(must(docker("run", "--rm", "--entrypoint", "python", IMAGE, "-c", looks))) == [port]
        assert json.loads(must(docker("exec", cluster.container("worker"), "python", "-c", looks))) == []


def test_a_worker_that_is_killed_costs_no_byte(cluster, expected_digest):
    out = cluster.checkout / "data" / "killed"
    second = cluster.container("worker", 2)
    with ThreadPoolExecutor() as beside:
        job = beside.submit(cluster, "run", "--rm", "job", "run", JOB, "--out", "data/killed", *SMALL_RANGES, "--json")
        name = _name_of(second)
        wait_for(lambda: name in _begun(out), 240, "a range of worker 2", every_s=0.02)  # a range takes 0.3 s
        must(docker("kill", "--signal", "KILL", second))
        answer = must(job.result())
    assert digest_in(answer) == expected_digest
    assert '"worker lost"' in (out / "_logs" / "verso.jsonl").read_text()


def test_down_leaves_nothing_but_the_data(cluster):
    must(cluster("down", "--volumes"))
    for what in (("ps", "--all"), ("network", "ls"), ("volume", "ls")):
        assert must(docker(*what, "--quiet", "--filter", f"name={cluster.project}_")) == "", what
    assert (cluster.checkout / "data" / "three" / "_SUCCESS").exists()


def _commands(container: str, other_than: str) -> list[str]:
    """Command lines of the container's processes that belong to another user than `other_than`."""
    asks = "for p in /proc/[0-9]*; do echo $(stat -c %u $p) $(tr '\\0' ' ' <$p/cmdline); done 2>/dev/null"
    lines = must(docker("exec", container, "sh", "-c", asks)).splitlines()
    return [command for user, _, command in (line.partition(" ") for line in lines) if user != other_than and command]


def _health(container: str) -> str:
    return must(docker("inspect", "--format", "{{.State.Health.Status}}", container)).strip()


def _this_machine() -> str:
    """Address of this machine on Docker's usual network: the way out of a container there.

    Docker's own `network inspect` has no gateway before the engine's second start.
    """
    asks = "import socket, struct; print([socket.inet_ntoa(struct.pack('<L', int(row[2], 16))) for row in"
    asks += " map(str.split, open('/proc/net/route').readlines()[1:]) if row[1] == '00000000'][0])"
    return must(docker("run", "--rm", "--entrypoint", "python", IMAGE, "-c", asks)).strip()


def _looks(host: str, ports: tuple[int, ...]) -> str:
    """A program that prints which of the ports answer at the host."""
    return f"""import socket
socket.setdefaulttimeout(1.5)
def answers(port):
    try:
        return socket.create_connection(({host!r}, port)) and True
    except OSError:
        return False
print([port for port in {ports} if answers(port)])"""


def _answers(host: str, port: int, bridge: str) -> bool:
    """Whether a port answers this machine, whose packets go onto the bridge and nowhere else."""
    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, bridge.encode())
        client.settimeout(1.5)
        try:
            client.connect((host, port))
        except OSError:
            return False
        return True


def _name_of(container: str) -> str:
    """The host's name inside a container."""
    return must(docker("inspect", "--format", "{{.Config.Hostname}}", container)).strip()


def _hosts(out: Path) -> set[str]:
    """Names of the hosts that made the ranges of a dataset, from the names of their attempts."""
    commits = [json.loads(path.read_text()) for path in (out / "manifest" / "_commits").glob("*.json")]
    return {commit["attempt"].split("-")[2] for commit in commits}


def _begun(out: Path) -> set[str]:
    """Names of the hosts that are making a range, from the names of their attempts."""
    return {path.name.split("-")[2] for path in out.glob("_staging/*/*-*-*-*")}  # beside temporary files

"""What is refused before Ray is asked, who can reach a private Ray and what it sends, its folder, and a cluster's slots."""

import itertools
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import ray
from ray._private.authentication.authentication_utils import is_token_auth_enabled

from schemas.errors import MachineError
from services.run import machine as module
from services.run.machine import (
    MAX_BASE_BYTES,
    PREFIX,
    SESSION_BYTES,
    SOCKET_BYTES,
    living_folders,
    private_folder,
)
from services.run.ray_cluster import (
    LOOK_EVERY_S,
    PREFETCH,
    Slots,
    cluster_slots,
    open_ray,
    private_environment,
    private_ray,
    slots_of,
)
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
from workers.store.file_system import OWNER

ROOT = Path(__file__).resolve().parents[3]
NOBODY = 65534


def test_an_address_without_a_port_or_where_nothing_answers_is_refused_at_once():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        silent = f"127.0.0.1:{unused.getsockname()[1]}"
        refusals = dict.fromkeys(["head", "head:", ":6379", "ray://head", "head:port"], "write it as HOST:PORT")
        for address, words in (refusals | {silent: "no Ray answers there"}).items():
            with pytest.raises(MachineError, match=f"{address}: {words}"), open_ray(address, None):
                pass


def test_a_cluster_whose_token_is_missing_is_told_in_one_line(tmp_path):
    """In a process of its own, because Ray reads the mode when it is imported."""
    mine = {name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")}
    mine |= {"RAY_AUTH_MODE": "token", "HOME": str(tmp_path)}
    program = "import sys; from services.run.ray_cluster import open_ray; open_ray(sys.argv[1], None).__enter__()"
    with socket.create_server(("127.0.0.1", 0)) as cluster:
        address = f"127.0.0.1:{cluster.getsockname()[1]}"
        run = [sys.executable, "-c", program, address]
        done = subprocess.run(run, cwd=ROOT, env=mine, capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"schemas.errors.MachineError: --address {address}: ")
    assert last.endswith("needs RAY_AUTH_MODE=token and its RAY_AUTH_TOKEN here too")


@pytest.mark.minute
@pytest.mark.ray
def test_a_private_ray_is_reached_by_nobody_else_and_leaves_nothing(tmp_path, monkeypatch):
    """For a user with settings of an own cluster, and a temporary folder with a name that is too long for sockets."""
    long = tmp_path / ("x" * 80)
    long.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "of-my-own-cluster")
    monkeypatch.setenv("RAY_REDIS_ADDRESS", "192.0.2.1:6379")
    monkeypatch.delenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", raising=False)
    before = dict(os.environ)
    with private_ray(1):
        task = ray.remote(lambda: {name: value for name, value in os.environ.items() if name.startswith("RAY_")})
        environment = ray.get(task.remote())
        listeners = listeners_of(os.getpid())
        sockets = [name for _, name in unix_sockets_of(os.getpid()) if "/session_" in name]
        folder = Path(sockets[0].partition("/session_")[0])
        mode = folder.parent.stat().st_mode & 0o777
        find = ["grep", "-rl", os.environ["RAY_AUTH_TOKEN"], str(folder)]
        token_files = subprocess.run(find, capture_output=True, text=True, check=False).stdout.splitlines()
    by_ray = {
        each for each in listeners if each.process in ("gcs_server", "raylet") or each.process.startswith("ray::")
    }
    assert {"gcs_server", "raylet"} < {each.process for each in by_ray}
    assert {each.address for each in by_ray} <= {"127.0.0.1", "::1"}
    assert not [each for each in listeners if "Dashboard" in each.process or each.port == 52365], "an agent takes jobs"
    assert len(sockets) >= 2 and all(name.startswith(f"{folder}/") for name in sockets)
    assert mode == 0o700 and len(str(folder)) < 43
    assert not folder.parent.exists()
    assert (environment["RAY_AUTH_MODE"], len(environment["RAY_AUTH_TOKEN"]), token_files) == ("token", 64, [])
    assert "RAY_REDIS_ADDRESS" not in environment
    assert {name: os.environ.get(name) for name in before} == before, "the user's settings count again"
    assert not is_token_auth_enabled()


def test_each_run_has_a_token_of_its_own_that_nobody_guesses_and_the_rest_is_the_same():
    first, second = private_environment(), private_environment()
    tokens = {one.pop("RAY_AUTH_TOKEN") for one in (first, second)}
    assert len(tokens) == 2 and all(len(bytes.fromhex(token)) >= 32 for token in tokens)
    assert first == second and first["RAY_AUTH_MODE"] == "token" and first["RAY_REDIS_ADDRESS"] is None


def test_slots_follow_the_cores_of_the_cluster_which_is_asked_now_and_then(monkeypatch):
    assert Slots(2, 4).now() == Slots(2, 4)
    for cores, workers, slots in (
        (6, None, Slots(6, 6 * PREFETCH)),
        (0, None, Slots(1, PREFETCH)),
        (6, 2, Slots(2, 2)),  # where there are fewer workers than cores no shard waits
        (2, 6, Slots(2, 2 * PREFETCH)),
    ):
        assert slots_of(cores, workers) == slots
    for cores, jobs in itertools.product(range(1, 20), range(2, 6)):  # even shares: no core is idle, no job without
        assert slots_of(cores, None, jobs) == Slots(share := math.ceil(cores / jobs), share)
    cores, now, asked = [2], [100.0], []

    def count() -> int:
        asked.append(now[0])
        return cores[0]

    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    slots = cluster_slots(count, None, lambda: 1)
    assert (slots.running, slots.in_flight) == (2, 2 * PREFETCH)
    seen = []
    for cores[0] in (2, 8, 0, 3):
        now[0] += LOOK_EVERY_S
        seen.append(slots.now().running)
        now[0] += LOOK_EVERY_S / 4
        assert slots.now().running == seen[-1]
    assert (seen, len(asked)) == ([2, 8, 1, 3], 5)


# ------------------------------------------------------------------------------------------------ its folder


@pytest.fixture
def short(monkeypatch):
    """An empty temporary folder with a short name, which is the user's."""
    folder = Path(tempfile.mkdtemp(prefix="t", dir="/tmp"))
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setattr(module, "OTHERS", ())
    yield folder
    shutil.rmtree(folder)


def killed_owner(place: Path) -> Path:
    """The folder of a process that was killed while it had one below `place`."""
    program = "import os, sys, tempfile\nfrom pathlib import Path\nfrom services.run import machine\n"
    program += "tempfile.tempdir, machine.OTHERS = sys.argv[1], ()\n"
    program += "with machine.private_folder() as folder:\n    (folder / 'log').touch(); os.kill(os.getpid(), 9)"
    before = set(place.iterdir())
    done = subprocess.run([sys.executable, "-c", program, str(place)], check=False)
    assert done.returncode == -signal.SIGKILL
    (left,) = set(place.iterdir()) - before
    assert (left / "r" / "log").exists()
    return left


def test_the_folder_of_a_dead_owner_goes_at_the_next_start_and_that_of_a_living_one_at_its_end(short, monkeypatch):
    with private_folder() as alive:
        (alive / "logs").mkdir()
        (alive / "logs" / "raylet.out").write_text("x")
        dead = killed_owner(short)
        with monkeypatch.context() as busy:
            busy.setattr(shutil, "rmtree", lambda folder, **_: None)  # a process that is just ending still writes there
            living_folders()
        assert (dead / OWNER).exists(), "half removed, it is found again"
        with private_folder():
            assert not dead.exists()
            assert alive.exists()
    assert list(short.iterdir()) == []


def test_what_only_looks_like_one_or_is_another_users_stays(short):
    (short / f"{PREFIX}mine").mkdir()
    (short / f"{PREFIX}file").touch()
    elsewhere = killed_owner(short).rename(short / "elsewhere")
    (short / f"{PREFIX}link").symlink_to(elsewhere)
    if os.geteuid() == 0:
        os.chown(killed_owner(short), NOBODY, NOBODY)
    before = sorted(short.rglob("*"))
    living_folders()
    assert sorted(short.rglob("*")) == before


def test_a_name_that_is_too_long_for_sockets_leads_to_another_folder_or_is_told(short, monkeypatch):
    longest, long = short / ("x" * (MAX_BASE_BYTES - len(str(short)) - 1)), f"/tmp/{'ü' * MAX_BASE_BYTES}"
    longest.mkdir()
    for wanted, others in ((str(longest), ()), (long, (short / "missing", longest))):
        monkeypatch.setattr(tempfile, "tempdir", wanted)
        monkeypatch.setattr(module, "OTHERS", others)
        with private_folder() as folder:
            assert folder.is_relative_to(longest)
            assert len(str(folder) + "/" + "s" * (SESSION_BYTES - 1)) == SOCKET_BYTES
    monkeypatch.setattr(module, "OTHERS", (short / "missing",))
    sizes = f"{len(os.fsencode(long))} bytes, at most {MAX_BASE_BYTES} fit"
    with (
        pytest.raises(MachineError, match=rf"{long} has {sizes}.*missing \(No such file.*set TMPDIR"),
        private_folder(),
    ):
        pass


# ----------------------------------------------------------------------- a host of its own, attacked

JOB = ROOT / "deploy" / "jobs" / "tabletop.yaml"


@dataclass
class Attack:
    """What a run on a host of its own let happen."""

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
        options = ["--scenes", "8", "--workers", "2", "--shard-size", "4", "--set", "run.range_size=4"]
        command = [sys.executable, "-m", "services.cli.main", "run", str(JOB), "--out", str(folder / "out"), *options]
        run = subprocess.Popen(network.command(command), cwd=ROOT, stderr=subprocess.PIPE, text=True)
        attacker = [sys.executable, str(ROOT / "tests" / "kit" / "callers_without_token.py"), f"touch {victim}"]
        caller = subprocess.Popen(
            network.command(attacker),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={name: value for name, value in os.environ.items() if not name.startswith("RAY_")},
        )
        try:
            listeners = wait_for_workers(run)
            answers = json.loads(caller.communicate(json.dumps(sorted({one.port for one in listeners})) + "\n")[0])
            reached = network.from_outside(lambda: scan(run))
            _, errors = run.communicate(timeout=300)
        finally:
            for process in (run, caller):
                if process.poll() is None:
                    process.kill()
    assert run.returncode == 0, errors
    return Attack(reached, answers, list(frames), victim.exists())


def wait_for_workers(run: subprocess.Popen) -> set[Listener]:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and run.poll() is None:
        listeners = listeners_of(run.pid)
        names = [listener.process for listener in listeners]
        if sum(name.startswith("ray::") and "Agent" not in name and "Env" not in name for name in names) >= 2:
            return listeners
        time.sleep(0.05)
    raise AssertionError(f"no two workers listen: {run.poll()}, {sorted(listeners_of(run.pid))}")


def scan(run: subprocess.Popen) -> list[int]:
    """Tries each port from outside, while the coordinator is held, so that nothing ends meanwhile."""
    ours = [pid for pid in tree_of(run.pid) if b"services.cli.main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    coordinator = ours[-1]  # below its supervisors
    os.kill(coordinator, signal.SIGSTOP)
    try:
        return open_ports(HOST_LAN, range(1, 65536))
    finally:
        os.kill(coordinator, signal.SIGCONT)


@pytest.mark.root
@pytest.mark.ray
@pytest.mark.timeout(600)
def test_nothing_answers_from_outside_nothing_is_sent_and_a_local_process_without_the_token_is_refused(attack):
    assert attack.reached == []
    assert attack.frames == []
    grpc_ports = http_ports = 0
    for port, calls in attack.answers.items():
        given = set(calls.values()) - {"UNIMPLEMENTED", "UNAVAILABLE"}
        grpc_ports += "UNAUTHENTICATED" in given
        http_ports += any(answer.isdigit() for answer in given)
        assert given <= {"401", "UNAUTHENTICATED", "BadStatusLine", "RemoteDisconnected", "ConnectionResetError"}, port
    assert grpc_ports >= 5, attack.answers  # GCS, the raylet's two, the coordinator, two workers
    assert http_ports >= 1, attack.answers  # the agent for environments
    assert not attack.injected


@pytest.mark.root
@pytest.mark.ray
@pytest.mark.timeout(600)
def test_what_is_sent_would_be_seen(network):
    """The watch itself: a look-up of a name, and a metadata service that is asked."""
    ask = "import socket, contextlib\nfor host in ('metadata.google.internal', '169.254.169.254'):\n"
    ask += "    with contextlib.suppress(OSError):\n        socket.create_connection((host, 80), timeout=1)"
    with network.watch() as frames:
        before = len(frames)
        subprocess.run(network.command([sys.executable, "-c", ask]), check=True)
    sent = set(frames[before:])
    assert {"UDP to 10.211.0.1:53", "TCP to 169.254.169.254:80"} <= sent, sent

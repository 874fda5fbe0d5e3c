"""What is refused before Ray is asked, who can reach a private Ray, its folder, and the slots of a cluster."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import ray
from ray._private.authentication.authentication_utils import is_token_auth_enabled

from schemas.errors import MachineError
from services.run import ray_cluster as module
from services.run.ray_cluster import (
    LOOK_EVERY_S,
    MAX_BASE_BYTES,
    NOT_INHERITED,
    OWNER,
    PREFETCH,
    PREFIX,
    SESSION_BYTES,
    SOCKET_BYTES,
    Slots,
    cluster_slots,
    open_ray,
    private_environment,
    private_folder,
    private_ray,
    remove_dead,
    slots_of,
)
from tests.kit.network import listeners_of, unix_sockets_of

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


def test_ray_is_started_in_one_place():
    sources = [path for folder in ("schemas", "services", "workers") for path in (ROOT / folder).rglob("*.py")]
    assert [path.name for path in sources if "ray.init(" in path.read_text()] == ["ray_cluster.py"]


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
        told = ray.get(task.remote())
        listeners = listeners_of(os.getpid())
        sockets = [name for _, name in unix_sockets_of(os.getpid()) if "/session_" in name]
        folder = Path(sockets[0].partition("/session_")[0])
        mode = folder.parent.stat().st_mode & 0o777
        find = ["grep", "-rl", os.environ["RAY_AUTH_TOKEN"], str(folder)]
        token_files = subprocess.run(find, capture_output=True, text=True, check=False).stdout.splitlines()
    by_ray = {one for one in listeners if one.process in ("gcs_server", "raylet") or one.process.startswith("ray::")}
    assert {"gcs_server", "raylet"} < {one.process for one in by_ray}
    assert {one.address for one in by_ray} <= {"127.0.0.1", "::1"}
    assert [one for one in listeners if "Dashboard" in one.process or one.port == 52365] == [], (
        "an agent that takes jobs"
    )
    assert len(sockets) >= 2 and all(name.startswith(f"{folder}/") for name in sockets)
    assert mode == 0o700 and len(str(folder)) < 43
    assert not folder.parent.exists()
    assert (told["RAY_AUTH_MODE"], len(told["RAY_AUTH_TOKEN"]), token_files) == ("token", 64, [])
    assert "RAY_REDIS_ADDRESS" not in told
    assert {name: os.environ.get(name) for name in before} == before, "the user's settings count again"
    assert not is_token_auth_enabled()


def test_each_run_has_a_token_of_its_own_that_nobody_guesses_and_the_rest_is_the_same():
    first, second = private_environment(), private_environment()
    tokens = {one.pop("RAY_AUTH_TOKEN") for one in (first, second)}
    assert len(tokens) == 2 and all(len(bytes.fromhex(token)) >= 32 for token in tokens)
    assert first == second and first["RAY_AUTH_MODE"] == "token" and not set(NOT_INHERITED) & set(first)


def test_slots_follow_the_cores_of_the_cluster_which_is_asked_now_and_then():
    assert Slots(2, 4).now() == Slots(2, 4)
    for cores, workers, slots in (
        (6, None, Slots(6, 6 * PREFETCH)),
        (0, None, Slots(1, PREFETCH)),
        (6, 2, Slots(2, 2)),  # where there are fewer workers than cores no shard waits
        (2, 6, Slots(2, 2 * PREFETCH)),
    ):
        assert slots_of(cores, workers) == slots
    cores, now, asked = [2], [100.0], []

    def count() -> int:
        asked.append(now[0])
        return cores[0]

    slots = cluster_slots(count, None, clock=lambda: now[0])
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
    program = "import os, sys, tempfile\nfrom pathlib import Path\nfrom services.run import ray_cluster\n"
    program += "tempfile.tempdir, ray_cluster.OTHERS = sys.argv[1], ()\n"
    program += "with ray_cluster.private_folder() as folder:\n    (folder / 'log').touch(); os.kill(os.getpid(), 9)"
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
            remove_dead(short)
        assert (dead / OWNER).exists(), "half removed, it is found again"
        with private_folder():
            assert not dead.exists()
            assert alive.exists()
    assert list(short.iterdir()) == []


def test_what_only_looks_like_one_stays(short):
    (short / f"{PREFIX}mine").mkdir()
    (short / f"{PREFIX}file").touch()
    elsewhere = killed_owner(short).rename(short / "elsewhere")
    (short / f"{PREFIX}link").symlink_to(elsewhere)
    remove_dead(short)
    assert {found.name for found in short.iterdir()} == {f"{PREFIX}mine", f"{PREFIX}file", f"{PREFIX}link", "elsewhere"}
    assert (elsewhere / "r" / "log").exists()


@pytest.mark.root
def test_the_folder_of_another_user_stays(short):
    dead = killed_owner(short)
    os.chown(dead, NOBODY, NOBODY)
    remove_dead(short)
    assert dead.exists()


def test_a_name_that_is_too_long_for_sockets_leads_to_another_folder_or_is_told(short, monkeypatch):
    longest, other = short / ("x" * (MAX_BASE_BYTES - len(str(short)) - 1)), short / "other"
    for place in (longest, other):
        place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(longest))
    with private_folder() as folder:
        assert folder.is_relative_to(longest)
        assert len(str(folder) + "/" + "s" * (SESSION_BYTES - 1)) == SOCKET_BYTES
    long = f"/tmp/{'ü' * MAX_BASE_BYTES}"
    monkeypatch.setattr(tempfile, "tempdir", long)
    monkeypatch.setattr(module, "OTHERS", (short / "missing", other))
    with private_folder() as folder:
        assert folder.is_relative_to(other)
    monkeypatch.setattr(module, "OTHERS", (short / "missing",))
    sizes = f"{len(os.fsencode(long))} bytes, at most {MAX_BASE_BYTES} fit"
    with (
        pytest.raises(MachineError, match=rf"{long} has {sizes}.*missing \(No such file.*set TMPDIR"),
        private_folder(),
    ):
        pass


def connects_as_nobody(name: Path) -> bool:
    """Whether another user reaches the socket; in a child process, which gives up being root."""
    child = os.fork()
    if not child:
        os.setgid(NOBODY)
        os.setuid(NOBODY)
        with socket.socket(socket.AF_UNIX) as caller:
            os._exit(caller.connect_ex(str(name)))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.root
def test_another_user_cannot_reach_a_socket_that_is_open_to_all(short):
    short.chmod(0o777)
    with private_folder() as folder:
        reached = {}
        for place in (short, folder):
            place.chmod(0o777)  # as Ray does with its own
            with socket.socket(socket.AF_UNIX) as server:
                server.bind(str(place / "raylet"))
                server.listen()
                (place / "raylet").chmod(0o777)
                reached[place] = connects_as_nobody(place / "raylet")
        assert reached == {short: True, folder: False}

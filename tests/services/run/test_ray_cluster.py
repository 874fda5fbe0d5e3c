"""What is refused before Ray is asked, and who can reach a private Ray; runs are in test_step.py."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import ray
from ray._private.authentication.authentication_utils import is_token_auth_enabled

from schemas.errors import MachineError
from services.run import ray_cluster as ray_folder
from services.run.ray_cluster import (
    LOOK_EVERY_S,
    MAX_BASE_BYTES,
    NOT_INHERITED,
    OWNER,
    PREFETCH,
    PREFIX,
    SESSION_BYTES,
    SOCKET_BYTES,
    ClusterSlots,
    Slots,
    open_ray,
    private_environment,
    private_folder,
    private_ray,
    remove_dead,
    slots_of,
)
from tests.kit.network import Listener, listeners_of, unix_sockets_of

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("address", ["head", "head:", ":6379", "ray://head", "head:port"])
def test_an_address_without_a_port_is_refused_with_its_form(address):
    with pytest.raises(MachineError, match="write it as HOST:PORT"), open_ray(address, None):
        pass


def test_an_address_where_nothing_answers_is_refused_at_once():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(MachineError, match=f"{address}: no Ray answers there"), open_ray(address, None):
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
    starts = [path.name for path in sources if "ray.init(" in path.read_text()]
    assert starts == ["ray_cluster.py"]


@dataclass
class Seen:
    """A private Ray as the kernel, one of its tasks and its own log show it, and what it left."""

    listeners: set[Listener]
    unix_sockets: set[tuple[str, str]]
    folder: Path
    modes: list[int]
    told_worker: dict[str, str]
    tokens_in_files: list[str]
    environment: dict[str, dict[str, str]]
    token_asked_after: bool


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> Iterator[Seen]:
    """One private Ray, for a user with settings of an own cluster and a temporary folder with a long name."""
    long = tmp_path_factory.mktemp("x" * 40)
    with pytest.MonkeyPatch.context() as user:
        user.setattr(tempfile, "tempdir", str(long))
        user.setenv("RAY_AUTH_MODE", "disabled")
        user.setenv("RAY_AUTH_TOKEN", "of-my-own-cluster")
        user.setenv("RAY_REDIS_ADDRESS", "192.0.2.1:6379")
        user.delenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", raising=False)
        before = dict(os.environ)
        with private_ray(1):
            task = ray.remote(lambda: {name: value for name, value in os.environ.items() if name.startswith("RAY_")})
            told = ray.get(task.remote())
            listeners, unix_sockets = listeners_of(os.getpid()), unix_sockets_of(os.getpid())
            ours = {(who, name) for who, name in unix_sockets if "/session_" in name}
            folder = Path(min(name for _, name in ours).partition("/session_")[0])
            modes = [above.stat().st_mode & 0o777 for above in (folder.parent, folder)]
            find = ["grep", "-rl", os.environ["RAY_AUTH_TOKEN"], str(folder)]
            files = subprocess.run(find, capture_output=True, text=True, check=False).stdout.splitlines()
        after = {name: value for name, value in os.environ.items() if name in before}
        yield Seen(
            listeners, ours, folder, modes, told, files, {"before": before, "after": after}, is_token_auth_enabled()
        )


@pytest.mark.ray
def test_a_private_ray_listens_on_loopback_alone(seen):
    by_ray = {
        one for one in seen.listeners if one.process in ("gcs_server", "raylet") or one.process.startswith("ray::")
    }
    assert {"gcs_server", "raylet"} < {one.process for one in by_ray}
    assert {one.address for one in by_ray} <= {"127.0.0.1", "::1"}


@pytest.mark.ray
def test_its_agent_takes_no_jobs(seen):
    assert [one for one in seen.listeners if "Dashboard" in one.process or one.port == 52365] == []


@pytest.mark.ray
def test_its_sockets_are_where_no_other_user_enters(seen):
    assert len(seen.unix_sockets) >= 2
    assert all(name.startswith(f"{seen.folder}/") for _, name in seen.unix_sockets)
    assert seen.modes[0] == 0o700


@pytest.mark.ray
def test_a_long_temporary_folder_and_its_own_folder_are_left(seen):
    assert len(str(seen.folder)) < 43
    assert not seen.folder.parent.exists()


@pytest.mark.ray
def test_its_workers_ask_for_the_token_of_this_run(seen):
    assert seen.told_worker["RAY_AUTH_MODE"] == "token"
    assert len(seen.told_worker["RAY_AUTH_TOKEN"]) == 64
    assert "RAY_REDIS_ADDRESS" not in seen.told_worker
    assert seen.tokens_in_files == []


@pytest.mark.ray
def test_afterwards_the_settings_of_the_users_own_cluster_count_again(seen):
    assert seen.environment["after"] == seen.environment["before"]
    assert not seen.token_asked_after


def test_fixed_slots_stay():
    assert Slots(2, 4).now() == Slots(2, 4)


def test_a_cluster_has_a_slot_for_each_core_and_one_where_it_has_none():
    assert slots_of(6, None) == Slots(6, 6 * PREFETCH)
    assert slots_of(0, None) == Slots(1, PREFETCH)


def test_with_fewer_workers_than_cores_no_shard_waits():
    assert slots_of(6, 2) == Slots(2, 2)
    assert slots_of(2, 6) == Slots(2, 2 * PREFETCH)


def test_slots_grow_and_shrink_with_the_cluster_and_ask_it_now_and_then():
    cores, now, asked = [2], [100.0], []

    def count() -> int:
        asked.append(now[0])
        return cores[0]

    slots = ClusterSlots.of(count, None, clock=lambda: now[0])
    assert (slots.running, slots.in_flight) == (2, 2 * PREFETCH)
    seen = []
    for cores[0] in (2, 8, 0, 3):
        now[0] += LOOK_EVERY_S
        seen.append(slots.now().running)
        now[0] += LOOK_EVERY_S / 4
        assert slots.now().running == seen[-1]
    assert seen == [2, 8, 1, 3]
    assert len(asked) == 5


def test_each_run_has_a_token_of_its_own_that_nobody_guesses():
    first, second = (private_environment()["RAY_AUTH_TOKEN"] for _ in range(2))
    assert first != second
    assert len(bytes.fromhex(first)) >= 32


def test_the_rest_is_the_same_for_every_run():
    first, second = ({**private_environment(), "RAY_AUTH_TOKEN": ""} for _ in range(2))
    assert first == second
    assert first["RAY_AUTH_MODE"] == "token"
    assert not set(NOT_INHERITED) & set(first)


NOBODY = 65534


@pytest.fixture
def short(monkeypatch):
    """An empty temporary folder with a short name, which is the user's."""
    folder = Path(tempfile.mkdtemp(prefix="t", dir="/tmp"))
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setattr(ray_folder, "OTHERS", ())
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


def test_it_is_removed_with_all_that_is_in_it(short):
    with private_folder() as folder:
        (folder / "logs").mkdir()
        (folder / "logs" / "raylet.out").write_text("x")
        assert [found.name[: len(PREFIX)] for found in short.iterdir()] == [PREFIX]
    assert list(short.iterdir()) == []


def test_the_folder_of_a_dead_owner_goes_at_the_next_start_and_that_of_a_living_one_stays(short):
    with private_folder() as alive:
        dead = killed_owner(short)
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


def test_a_folder_that_was_half_removed_is_found_again(short, monkeypatch):
    dead = killed_owner(short)
    with monkeypatch.context() as busy:
        busy.setattr(shutil, "rmtree", lambda folder, **_: None)  # a process that is just ending still writes there
        remove_dead(short)
    assert (dead / OWNER).exists()
    remove_dead(short)
    assert not dead.exists()


def test_the_longest_name_that_is_accepted_still_fits_a_socket(short, monkeypatch):
    place = short / ("x" * (MAX_BASE_BYTES - len(str(short)) - 1))
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    with private_folder() as folder:
        assert folder.is_relative_to(place)
        name = str(folder) + "/" + "s" * (SESSION_BYTES - 1)
        assert len(name) == SOCKET_BYTES


def test_a_name_that_is_too_long_leads_to_another_folder(short, monkeypatch):
    other = short / "other"
    other.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(short / ("x" * MAX_BASE_BYTES)))
    monkeypatch.setattr(ray_folder, "OTHERS", (short / "missing", other))
    with private_folder() as folder:
        assert folder.is_relative_to(other)


def test_without_any_other_folder_the_name_that_is_too_long_is_told(short, monkeypatch):
    long = f"/tmp/{'ü' * MAX_BASE_BYTES}"
    monkeypatch.setattr(tempfile, "tempdir", long)
    monkeypatch.setattr(ray_folder, "OTHERS", (short / "missing",))
    told = (
        rf"{long} has {len(os.fsencode(long))} bytes, at most {MAX_BASE_BYTES} fit.*missing \(No such file.*set TMPDIR"
    )
    with pytest.raises(MachineError, match=told), private_folder():
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

"""What is refused before Ray is asked, and who can reach a private Ray; runs are in test_step.py."""

import os
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
from services.run.ray_cluster import open_ray, private_ray
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

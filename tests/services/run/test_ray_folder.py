"""The folder of a private Ray: who can enter it, how long its name is, and when it goes."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from schemas.errors import MachineError
from services.run import ray_cluster as ray_folder
from services.run.ray_cluster import (
    MAX_BASE_BYTES,
    OWNER,
    PREFIX,
    SESSION_BYTES,
    SOCKET_BYTES,
    private_folder,
    remove_dead,
)

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
    program = "import os, sys, tempfile\nfrom pathlib import Path\nfrom services.run import ray_folder\n"
    program += "tempfile.tempdir, ray_folder.OTHERS = sys.argv[1], ()\n"
    program += "with ray_folder.private_folder() as folder:\n    (folder / 'log').touch(); os.kill(os.getpid(), 9)"
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

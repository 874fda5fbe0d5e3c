"""The launcher, with an interpreter and package tools that only write down what they were asked to do."""

import os
import shutil
import signal
import subprocess
import time
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LOCKS = ("requirements.lock", "requirements-pathtraced.lock", "requirements-dev.lock")

# Answers the launcher's probe, makes a `.venv` that links back to itself, and logs every call of pip.
# Files named after what should go wrong, in the folder $FAULTS, make it go wrong.
FAKE_PYTHON = r"""#!/bin/bash
log() { echo "$*" >>"$FAULTS/log"; }
case "$*" in
  "-V") echo "Python 3.12.9" ;;
  "-I -") cat >/dev/null; [ -e "$FAULTS/wrong-version" ] && exit 1; readlink -f "$0" ;;
  "-I -c import ensurepip, venv") [ ! -e "$FAULTS/no-ensurepip" ] ;;
  "-I -m venv "*) log "venv"; mkdir -p "${!#}/bin"; ln -s "$(readlink -f "$0")" "${!#}/bin/python"; echo "chatter" ;;
  "-I -m pip --version") ;;
  "-I -m pip "*) log "$@"; echo "chatter"
     [ -e "$FAULTS/pip-fails" ] && exit 1
     [ -e "$FAULTS/pip-hangs" ] && { touch "$FAULTS/hanging"; sleep 60; }
     [ -e "$FAULTS/pip-is-slow" ] && sleep 0.5; true ;;
  "-P -m services.cli.main"*) printf '%s|' "${@:4}" "path=${PYTHONPATH-}" "in=$PWD"
     [ ! -e "$FAULTS/exit" ] || exit "$(cat "$FAULTS/exit")" ;;
  *) echo "unexpected: $*" >&2; exit 99 ;;
esac
"""

FAKES = {
    "python3.11": FAKE_PYTHON,
    "python3": FAKE_PYTHON,
    "dpkg-query": '#!/bin/bash\n[ -e "$FAULTS/no-$4" ] || echo "install ok installed"\n',
    "apt-get": '#!/bin/bash\necho "apt-get ${@: -3}" >>"$FAULTS/log"; [ ! -e "$FAULTS/apt-fails" ]\n',
    "id": '#!/bin/bash\n[ -e "$FAULTS/not-root" ] && echo 1000 || echo 0\n',
    "sudo": "#!/bin/bash\nexit 1\n",
}


class Checkout:
    """A copy of the launcher and its files, and the fakes it will find on the path."""

    def __init__(self, folder: Path) -> None:
        self.root, self.faults, self.bin = folder / "check out", folder / "faults", folder / "bin"
        for made in (self.root, self.faults, self.bin):
            made.mkdir()
        shutil.copy(ROOT / "verso", self.root)
        for name in (*LOCKS, "pyproject.toml"):
            (self.root / name).write_text(f"contents of {name}\n")
        for name, script in FAKES.items():
            (self.bin / name).write_text(script)
            (self.bin / name).chmod(0o755)
        self.venv = self.root / ".venv"

    def start(self, *args: str, launcher: Path | None = None, cwd: Path | None = None) -> subprocess.Popen[str]:
        environ = {"PATH": f"{self.bin}:/usr/bin:/bin", "FAULTS": str(self.faults), "PYTHONPATH": "/opt/ros"}
        command = [str(launcher or self.root / "verso"), *args]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            command, env=environ, cwd=cwd or self.faults, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        )

    def run(self, *args: str, launcher: Path | None = None, cwd: Path | None = None) -> tuple[int, str, str]:
        process = self.start(*args, launcher=launcher, cwd=cwd)
        out, err = process.communicate(timeout=60)
        return process.returncode, out, err

    def fault(self, name: str) -> Path:
        file = self.faults / name
        file.touch()
        return file

    def calls(self) -> list[str]:
        """What was asked of pip, venv and apt-get since the last time."""
        log = self.faults / "log"
        lines = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        return [line.replace("-I -m pip install --quiet --no-deps ", "pip ") for line in lines]


@pytest.fixture
def checkout(tmp_path):
    return Checkout(tmp_path)


def locked(name: str, root: Path, *options: str) -> str:
    return " ".join(["pip --only-binary :all: --require-hashes", *options, f"-r {root}/{name}"])


def project(root: Path) -> str:
    return f"pip --no-index --no-build-isolation --config-settings editable_mode=compat --editable {root}"


# ------------------------------------------------------------------------------------------------ the ordinary course


def test_the_first_start_installs_the_lock_then_the_project_and_the_second_nothing(checkout):
    code, out, err = checkout.run("status", "a b", "*")
    assert (code, out) == (0, f"status|a b|*|path=|in={checkout.faults}|")  # and none of pip's chatter
    assert "first start" in err
    assert checkout.calls() == ["venv", locked("requirements.lock", checkout.root), project(checkout.root)]
    assert checkout.run("status") == (0, f"status|path=|in={checkout.faults}|", "")
    assert checkout.calls() == []


def test_the_commands_exit_code_is_the_launchers(checkout):
    (checkout.faults / "exit").write_text("2")
    assert checkout.run("run")[0] == 2


def test_it_works_through_a_link_from_any_folder(checkout, tmp_path):
    link, elsewhere = tmp_path / "bin" / "verso", tmp_path / "elsewhere"
    link.symlink_to(checkout.root / "verso")
    elsewhere.mkdir()
    assert checkout.run("doctor", launcher=link, cwd=elsewhere)[:2] == (0, f"doctor|path=|in={elsewhere}|")
    assert checkout.venv.is_dir()


def test_the_test_tools_come_with_the_first_test_alone(checkout):
    checkout.run("--version")
    checkout.calls()
    assert checkout.run("test", "--ci")[0] == 0
    assert checkout.calls() == [locked("requirements-dev.lock", checkout.root)]
    checkout.run("test")
    checkout.run("--version")
    assert checkout.calls() == []


@pytest.mark.parametrize("changed", ["requirements.lock", "pyproject.toml"])
def test_a_changed_lock_updates_the_environment_in_place(checkout, changed):
    checkout.run("--version")
    checkout.calls()
    (checkout.venv / "kept").touch()
    (checkout.root / changed).write_text("something else\n")
    assert "has changed" in checkout.run("--version")[2]
    assert checkout.calls() == [locked("requirements.lock", checkout.root), project(checkout.root)]
    assert (checkout.venv / "kept").exists()
    assert checkout.run("--version")[2] == ""


def test_a_changed_development_lock_matters_to_tests_alone(checkout):
    checkout.run("test")
    checkout.calls()
    (checkout.root / "requirements-dev.lock").write_text("something else\n")
    checkout.run("--version")
    assert checkout.calls() == []
    checkout.run("test")
    assert checkout.calls() == [locked("requirements-dev.lock", checkout.root)]


def test_the_extra_is_installed_once_and_starts_no_command(checkout):
    code, out, err = checkout.run("extra", "pathtraced")
    assert (code, out) == (0, "")
    assert "pathtraced is installed" in err
    base = ["venv", locked("requirements.lock", checkout.root), project(checkout.root)]
    assert checkout.calls() == [*base, locked("requirements-pathtraced.lock", checkout.root)]
    assert checkout.run("extra", "pathtraced")[0] == 0
    checkout.run("--version")
    assert checkout.calls() == []
    (checkout.root / "requirements-pathtraced.lock").write_text("something else\n")
    checkout.run("extra", "pathtraced")
    assert checkout.calls() == [locked("requirements-pathtraced.lock", checkout.root)]


def test_the_extra_brings_the_library_that_its_package_lacks(checkout):
    checkout.run("--version")
    checkout.calls()
    checkout.fault("no-libatomic1")
    code, _, err = checkout.run("extra", "pathtraced")
    assert code == 0 and "installing Debian packages: libatomic1" in err
    assert checkout.calls()[0] == "apt-get -y --no-install-recommends libatomic1"


def test_the_extra_says_what_an_administrator_has_to_install(checkout):
    checkout.run("--version")
    for name in ("no-libatomic1", "not-root"):
        checkout.fault(name)
    code, _, err = checkout.run("extra", "pathtraced")
    assert code == 0 and "apt-get install libatomic1" in err


@pytest.mark.parametrize("words", [("extra",), ("extra", "gpu"), ("extra", "pathtraced", "please")])
def test_an_extra_that_there_is_not_is_refused_before_anything_is_made(checkout, words):
    code, out, err = checkout.run(*words)
    assert (code, out) == (2, "")
    assert "./verso extra pathtraced" in err
    assert not checkout.venv.exists()


# ------------------------------------------------------------------------------------------------ what goes wrong


def kill_while_pip_hangs(checkout: Checkout, *args: str) -> None:
    fault = checkout.fault("pip-hangs")
    process = checkout.start(*args)
    for _ in range(200):
        if (checkout.faults / "hanging").exists():
            break
        time.sleep(0.05)
    else:
        pytest.fail("the launcher never came to pip")
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    fault.unlink()
    (checkout.faults / "hanging").unlink()
    checkout.calls()


def test_a_killed_first_start_is_repaired_by_the_next(checkout):
    kill_while_pip_hangs(checkout, "--version")
    (checkout.venv / "half a package").touch()
    code, _, err = checkout.run("--version")
    assert code == 0
    assert "did not finish" in err
    assert checkout.calls()[0] == "venv"
    assert not (checkout.venv / "half a package").exists()
    assert checkout.run("--version")[2] == ""


def test_a_killed_update_is_repaired_by_the_next_start(checkout):
    checkout.run("--version")
    (checkout.root / "requirements.lock").write_text("something else\n")
    kill_while_pip_hangs(checkout, "--version")
    assert "did not finish" in checkout.run("--version")[2]
    assert checkout.calls()[0] == "venv"


def test_test_tools_half_installed_are_installed_over(checkout):
    checkout.run("--version")
    kill_while_pip_hangs(checkout, "test")
    assert checkout.run("test")[0] == 0
    assert checkout.calls() == [locked("requirements-dev.lock", checkout.root, "--force-reinstall")]


def test_an_extra_half_installed_is_installed_over(checkout):
    checkout.run("--version")
    kill_while_pip_hangs(checkout, "extra", "pathtraced")
    assert checkout.run("extra", "pathtraced")[0] == 0
    assert checkout.calls() == [locked("requirements-pathtraced.lock", checkout.root, "--force-reinstall")]


def test_pip_failing_stops_with_its_reason_and_nothing_is_started(checkout):
    fault = checkout.fault("pip-fails")
    code, out, err = checkout.run("--version")
    assert (code, out) == (1, "")
    assert "pip could not finish" in err
    fault.unlink()
    assert checkout.run("--version")[0] == 0


def test_two_first_starts_at_once_set_up_once(checkout):
    checkout.fault("pip-is-slow")
    both = [checkout.start("--version") for _ in range(2)]
    ends = [process.communicate(timeout=60) for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert checkout.calls().count("venv") == 1
    assert sum("waiting" in err for _, err in ends) == 1


def test_a_moved_checkout_gets_a_new_environment(checkout):
    checkout.run("--version")
    checkout.calls()
    moved = checkout.root.rename(checkout.root.with_name("moved"))
    assert "has moved" in checkout.run("--version", launcher=moved / "verso")[2]
    assert checkout.calls() == ["venv", locked("requirements.lock", moved), project(moved)]


def test_an_environment_that_someone_else_made_is_left_alone(checkout):
    (checkout.venv / "bin").mkdir(parents=True)
    (checkout.venv / "bin" / "python").write_text("theirs")
    code, _, err = checkout.run("--version")
    assert code == 1
    assert "not made by this launcher" in err
    assert (checkout.venv / "bin" / "python").read_text() == "theirs"
    assert checkout.calls() == []


@pytest.mark.parametrize("python", ["another version", "none at all"])
def test_without_python_311_it_names_both_ways_on(checkout, python):
    if python == "another version":
        checkout.fault("wrong-version")
    else:
        for name in ("python3.11", "python3"):
            (checkout.bin / name).write_text("#!/bin/bash\nexit 127\n")
    code, out, err = checkout.run("--version")
    assert (code, out) == (1, "")
    assert ("Python 3.12.9" if python == "another version" else "no Python 3") in err
    assert "apt-get install python3.11" in err
    assert "docker compose up" in err
    assert not checkout.venv.exists()


# ------------------------------------------------------------------------------------------------ system packages


def test_as_root_missing_packages_are_installed_and_named(checkout):
    checkout.fault("no-libegl1")
    checkout.fault("no-ensurepip")
    code, _, err = checkout.run("--version")
    assert code == 0
    assert "installing Debian packages: libegl1 python3.11-venv" in err
    assert checkout.calls()[0] == "apt-get --no-install-recommends libegl1 python3.11-venv"


def test_without_root_it_asks_for_the_renderers_packages_and_goes_on(checkout):
    for name in ("not-root", "no-libgl1", "no-libgl1-mesa-dri"):
        checkout.fault(name)
    code, out, err = checkout.run("--version")
    assert (code, out.split("|")[0]) == (0, "--version")
    assert "apt-get install libgl1 libgl1-mesa-dri" in err
    assert not any(call.startswith("apt-get") for call in checkout.calls())


@pytest.mark.parametrize("obstacle", ["not-root", "apt-fails"])
def test_without_a_package_that_python_needs_it_stops(checkout, obstacle):
    checkout.fault(obstacle)
    checkout.fault("no-ensurepip")
    code, _, err = checkout.run("--version")
    assert code == 1
    assert "apt-get install python3.11-venv" in err
    assert not checkout.venv.exists()


# ------------------------------------------------------------------------------------------------ the lock files


@pytest.mark.parametrize("lock", LOCKS)
def test_the_locks_pin_everything_by_hash_and_name_no_index(lock):
    lines = (ROOT / lock).read_text().splitlines()
    pins = [line for line in lines if not line.startswith(" ")]
    assert all("==" in pin and pin.endswith("\\") for pin in pins)
    assert all(line.strip().startswith("--hash=sha256:") for line in lines if line.startswith(" "))
    assert not any("://" in line for line in lines)


def pins(lock: str) -> dict[str, str]:
    lines = (ROOT / lock).read_text().splitlines()
    return dict(line.rstrip(" \\").split("==") for line in lines if "==" in line)


def test_the_locks_agree_on_what_they_share():
    runtime, extra, development = (pins(lock) for lock in LOCKS)
    shared = runtime.keys() & development.keys()
    assert shared
    assert {name: runtime[name] for name in shared} == {name: development[name] for name in shared}
    assert extra and extra.items() <= development.items()
    assert not extra.keys() & runtime.keys()


def test_the_extra_is_pinned_alike_wherever_it_is_named():
    tree = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = tree["project"]["optional-dependencies"]["pathtraced"]
    assert asked == tree["dependency-groups"]["pathtraced"] == [f"mitsuba=={pins(LOCKS[1])['mitsuba']}"]

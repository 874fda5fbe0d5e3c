"""The launcher where a set-up is killed or fails, where two start at once, and where Python or a package is missing."""

import os
import signal
import time

import pytest

from tests.launcher.checkout import Checkout, locked, project


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

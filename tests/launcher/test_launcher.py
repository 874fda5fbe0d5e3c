"""The launcher: it sets up once, brings up to date what changed, survives kills and faults, and starts the command."""

import os
import re
import tomllib

import pytest

from tests.launcher.conftest import LOCKS, ROOT, locked, project

# ------------------------------------------------------------------------------------------------ its ordinary course


def test_the_first_start_installs_the_lock_then_the_project_and_the_second_nothing(checkout, tmp_path):
    code, out, err = checkout.run("status", "a b", "*")
    typed = f"typed={checkout.root / 'verso'}|"
    assert (code, out) == (0, f"status|a b|*|path=|in={checkout.faults}|{typed}")  # and none of pip's chatter
    assert "first start" in err
    assert checkout.calls() == ["venv", locked("requirements.lock", checkout.root), project(checkout.root)]
    assert checkout.run("status") == (0, f"status|path=|in={checkout.faults}|{typed}", "")
    link, elsewhere = checkout.bin / "verso", tmp_path / "elsewhere"
    link.symlink_to(checkout.root / "verso")
    elsewhere.mkdir()
    (checkout.faults / "exit").write_text("2")  # the command's exit code is the launcher's
    assert checkout.run("doctor", launcher=link, cwd=elsewhere)[:2] == (2, f"doctor|path=|in={elsewhere}|typed={link}|")
    assert checkout.calls() == []


@pytest.mark.parametrize("locked", ["", ".venv", ".venv.lock"])
def test_an_environment_that_is_somebody_elses_is_told_in_one_line_and_works_where_it_is_whole(checkout, locked):
    assert checkout.run("status")[0] == 0
    checkout.calls()
    (checkout.root / locked).chmod(0o555)
    checkout.through = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    assert checkout.run("status")[0] == 0
    code, _, told = checkout.run("tradeoff", "job.yaml")
    (checkout.root / locked).chmod(0o755)
    assert code == 1 and re.fullmatch(
        r"verso: .*/\.venv lacks what this command needs, and \w+ cannot write there: .*\n", told
    )
    assert checkout.calls() == []


@pytest.mark.parametrize("changed", ["requirements.lock", "pyproject.toml"])
def test_a_changed_lock_updates_the_environment_in_place(checkout, changed):
    checkout.run("--version")
    checkout.calls()
    (checkout.venv / "kept").touch()
    (checkout.root / changed).write_text("something else\n")
    assert "has changed" in checkout.run("--version")[2]
    assert checkout.calls() == [locked("requirements.lock", checkout.root), project(checkout.root)]
    assert (checkout.venv / "kept").exists() and checkout.run("--version")[2] == ""


@pytest.mark.parametrize(
    ("lock", "command"),
    [
        ("requirements-dev.lock", ["test", "--ci"]),
        ("requirements-pathtraced.lock", ["extra", "pathtraced"]),
        ("requirements-study.lock", ["extra", "study"]),
        ("requirements-study.lock", ["tradeoff", "job.yaml"]),
    ],
)
def test_a_further_lock_is_installed_with_the_first_command_that_needs_it_and_matters_to_no_other(
    checkout, lock, command
):
    checkout.run("--version")
    assert not any(lock in call for call in checkout.calls())
    for change in (False, True):
        if change:
            (checkout.root / lock).write_text("something else\n")
        for words in (("--version",), ("status", "tradeoff"), ("run", "test")):
            assert checkout.run(*words)[0] == 0 and checkout.calls() == []
        assert checkout.run(*command)[0] == 0
        assert checkout.calls() == [locked(lock, checkout.root)]
        assert checkout.run(*command)[0] == 0 and checkout.calls() == []


def test_extras_start_no_command_and_bring_the_library_that_their_package_lacks(checkout):
    code, out, err = checkout.run("extra", "study")
    assert (code, out) == (0, "") and "study is installed" in err
    assert "what plots and measures for tradeoff" in checkout.run("tradeoff", "job.yaml")[2] + err
    checkout.calls()
    checkout.fault("no-libatomic1")
    code, _, err = checkout.run("extra", "pathtraced")
    assert code == 0 and "installing Debian packages: libatomic1" in err
    assert checkout.calls()[0] == "apt-get -y --no-install-recommends libatomic1"
    checkout.fault("not-root")
    (checkout.root / "requirements-pathtraced.lock").write_text("something else\n")
    code, _, err = checkout.run("extra", "pathtraced")
    assert code == 0 and "apt-get install libatomic1" in err


def test_an_extra_that_there_is_not_is_refused_before_anything_is_made(checkout):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for words in (("extra",), ("extra", "gpu"), ("extra", "pathtraced", "please")):
        code, out, err = checkout.run(*words)
        assert (code, out) == (2, "") and all(f"./verso extra {name}" in err for name in extras)
        assert not checkout.venv.exists()


# ------------------------------------------------------------------------------------------------ faults


def test_a_killed_first_start_or_update_is_repaired_by_the_next(checkout):
    for lock in ("contents of requirements.lock\n", "something else\n"):
        (checkout.root / "requirements.lock").write_text(lock)
        checkout.kill_while_pip_hangs("--version")
        (checkout.venv / "half a package").touch()
        code, _, err = checkout.run("--version")
        assert code == 0 and "did not finish" in err
        assert checkout.calls()[0] == "venv" and not (checkout.venv / "half a package").exists()
        assert checkout.run("--version")[2] == ""


@pytest.mark.parametrize(
    ("words", "lock"), [(["test"], "requirements-dev.lock"), (["extra", "pathtraced"], "requirements-pathtraced.lock")]
)
def test_tools_half_installed_are_installed_over(checkout, words, lock):
    checkout.run("--version")
    checkout.kill_while_pip_hangs(*words)
    assert checkout.run(*words)[0] == 0
    assert checkout.calls() == [locked(lock, checkout.root, "--force-reinstall")]


def test_pip_failing_stops_with_its_reason_and_nothing_is_started(checkout):
    fault = checkout.fault("pip-fails")
    code, out, err = checkout.run("--version")
    assert (code, out) == (1, "") and "pip could not finish" in err
    fault.unlink()
    assert checkout.run("--version")[0] == 0


def test_two_first_starts_at_once_set_up_once(checkout):
    checkout.fault("pip-is-slow")
    both = [checkout.start("--version") for _ in range(2)]
    ends = [process.communicate(timeout=60) for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert checkout.calls().count("venv") == 1
    assert sum("waiting" in err for _, err in ends) == 1


def test_a_moved_checkout_gets_a_new_environment_and_one_that_someone_else_made_is_left_alone(checkout):
    checkout.run("--version")
    checkout.calls()
    moved = checkout.root.rename(checkout.root.with_name("moved"))
    assert "has moved" in checkout.run("--version", launcher=moved / "verso")[2]
    assert checkout.calls() == ["venv", locked("requirements.lock", moved), project(moved)]
    (moved / ".venv").rename(moved / "ours")
    (moved / ".venv" / "bin").mkdir(parents=True)
    (moved / ".venv" / "bin" / "python").write_text("theirs")
    code, _, err = checkout.run("--version", launcher=moved / "verso")
    assert code == 1 and "not made by this launcher" in err
    assert (moved / ".venv" / "bin" / "python").read_text() == "theirs" and checkout.calls() == []


def test_missing_packages_are_installed_and_named_as_root_or_else_asked_for(checkout):
    checkout.fault("no-libegl1")
    checkout.fault("no-ensurepip")
    for obstacle in ("not-root", "apt-fails"):  # without a package that Python needs it stops
        fault = checkout.fault(obstacle)
        code, _, err = checkout.run("--version")
        assert code == 1 and "python3.11-venv" in err.rpartition("apt-get install ")[2]
        assert not checkout.venv.exists()
        fault.unlink()
    checkout.calls()
    code, _, err = checkout.run("--version")
    assert code == 0 and "installing Debian packages: libegl1 python3.11-venv" in err
    assert checkout.calls()[0] == "apt-get --no-install-recommends libegl1 python3.11-venv"


def test_without_root_it_asks_for_the_renderers_packages_and_goes_on(checkout):
    for name in ("not-root", "no-libgl1", "no-libgl1-mesa-dri"):
        checkout.fault(name)
    code, out, err = checkout.run("--version")
    assert (code, out.split("|")[0]) == (0, "--version")
    assert "apt-get install libgl1 libgl1-mesa-dri" in err
    assert not any(call.startswith("apt-get") for call in checkout.calls())


# ------------------------------------------------------------------------------------------------ the lock files


def test_the_locks_pin_everything_by_hash_name_no_index_and_agree():
    pins: list[dict[str, str]] = []
    for lock in LOCKS:
        lines = (ROOT / lock).read_text().splitlines()
        named = [line for line in lines if not line.startswith(" ")]
        assert all("==" in pin and pin.endswith("\\") for pin in named) and not any("://" in line for line in lines)
        assert all(line.strip().startswith("--hash=sha256:") for line in lines if line.startswith(" "))
        pins.append(dict(pin.rstrip(" \\").split("==") for pin in named))
    runtime, traced, study, development = pins
    for lock in pins[1:]:
        shared = runtime.keys() & lock.keys()
        assert lock and {name: runtime[name] for name in shared} == {name: lock[name] for name in shared}
    assert (traced | study).items() <= development.items()
    assert runtime.keys() & development.keys() and not traced.keys() & runtime.keys()
    tree = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = tree["project"]["optional-dependencies"]
    assert extras == {name: tree["dependency-groups"][name] for name in extras}
    assert extras["pathtraced"] == [f"mitsuba=={traced['mitsuba']}"]
    assert set(extras["study"]) <= study.keys() and not set(extras["study"]) & runtime.keys()
    assert not set(extras["study"]) & {name.partition("==")[0] for name in tree["project"]["dependencies"]}

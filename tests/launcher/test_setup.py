"""The launcher's ordinary course: it sets up once, brings up to date what changed, and starts the command."""

import pytest

from tests.launcher.checkout import locked, project


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

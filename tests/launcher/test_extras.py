"""The extra `study` of the launcher: installed with the first `bench` or `tradeoff`, and by nothing else."""

import tomllib

import pytest

from tests.launcher.checkout import ROOT, Checkout, locked, project
from tests.launcher.test_locks import pins

LOCK = "requirements-study.lock"


@pytest.fixture
def checkout(tmp_path):
    made = Checkout(tmp_path)
    (made.root / LOCK).write_text(f"contents of {LOCK}\n")
    return made


@pytest.mark.parametrize("command", ["bench", "tradeoff"])
def test_the_first_bench_or_tradeoff_installs_the_extra_and_then_starts(checkout, command):
    code, out, err = checkout.run(command, "job.yaml")
    assert (code, out.split("|")[:2]) == (0, [command, "job.yaml"])
    assert "what plots and measures for bench and tradeoff" in err
    base = ["venv", locked("requirements.lock", checkout.root), project(checkout.root)]
    assert checkout.calls() == [*base, locked(LOCK, checkout.root)]
    assert checkout.run(command)[0] == 0
    assert checkout.calls() == []


def test_no_other_command_installs_it(checkout):
    for words in (("run", "job.yaml"), ("--version",), ("status", "bench"), ("test",), ("extra", "pathtraced")):
        assert checkout.run(*words)[0] == 0
    assert not any(LOCK in call for call in checkout.calls())


def test_it_is_installed_by_its_name_without_the_tracer_s_library(checkout):
    checkout.fault("no-libatomic1")
    code, out, err = checkout.run("extra", "study")
    assert (code, out) == (0, "") and "study is installed" in err
    calls = checkout.calls()
    assert calls[-1] == locked(LOCK, checkout.root) and not any(call.startswith("apt-get") for call in calls)


def test_a_changed_lock_of_the_extra_matters_to_its_commands_alone(checkout):
    checkout.run("bench")
    checkout.calls()
    (checkout.root / LOCK).write_text("something else\n")
    checkout.run("run")
    assert checkout.calls() == []
    checkout.run("tradeoff")
    assert checkout.calls() == [locked(LOCK, checkout.root)]


def test_the_usage_names_every_extra(checkout):
    code, _, err = checkout.run("extra", "studies")
    assert code == 2
    for name in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]:
        assert f"./verso extra {name}" in err


# ------------------------------------------------------------------------------------------------ the lock file


def test_the_lock_pins_everything_by_hash_and_names_no_index():
    lines = (ROOT / LOCK).read_text().splitlines()
    assert all("==" in line and line.endswith("\\") for line in lines if not line.startswith(" "))
    assert all(line.strip().startswith("--hash=sha256:") for line in lines if line.startswith(" "))
    assert not any("://" in line for line in lines)


def test_the_locks_agree_and_the_base_has_none_of_what_the_extra_brings():
    base, extra, development = (pins(name) for name in ("requirements.lock", LOCK, "requirements-dev.lock"))
    assert extra.items() <= development.items()
    assert {name: base[name] for name in base.keys() & extra.keys()}.items() <= extra.items()
    assert not {"flip-evaluator", "isal", "matplotlib", "contourpy", "fonttools"} & base.keys()


def test_the_extra_is_named_alike_wherever_it_is_named():
    tree = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = tree["project"]["optional-dependencies"]["study"]
    assert asked == tree["dependency-groups"]["study"]
    assert set(asked) <= pins(LOCK).keys()
    assert not set(asked) & {name.partition("==")[0] for name in tree["project"]["dependencies"]}

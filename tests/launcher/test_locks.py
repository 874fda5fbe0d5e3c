"""The lock files: pinned by hash, naming no index, and agreeing with one another and with pyproject.toml."""

import tomllib

import pytest

from tests.launcher.checkout import LOCKS, ROOT


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
    runtime, traced, study, audit, development = (pins(lock) for lock in LOCKS)
    shared = runtime.keys() & development.keys()
    assert shared
    assert {name: runtime[name] for name in shared} == {name: development[name] for name in shared}
    assert traced and study and audit
    assert (traced | study | audit).items() <= development.items()
    assert not traced.keys() & runtime.keys()
    for extra in (study, audit):
        assert {name: extra[name] for name in extra.keys() & runtime.keys()}.items() <= runtime.items()


def test_the_extra_is_pinned_alike_wherever_it_is_named():
    tree = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = tree["project"]["optional-dependencies"]["pathtraced"]
    assert asked == tree["dependency-groups"]["pathtraced"] == [f"mitsuba=={pins(LOCKS[1])['mitsuba']}"]
    assert tree["project"]["optional-dependencies"]["audit"] == tree["dependency-groups"]["audit"] == ["mujoco"]

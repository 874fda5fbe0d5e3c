"""Which other systems are compared, and what is said of one that dies."""

import sys

import pytest

from schemas.environment import FOR_SPEED
from schemas.errors import MachineError
from services.bench import others
from services.bench.others import start_side


def test_only_the_raster_tier_has_a_same_look_to_be_compared_with(bench):
    job = bench[0].context.job
    flat = job.model_copy(update={"render": job.render.model_copy(update={"tier": "flat"})})
    assert {"script_plain", "script_same_look"} <= {side.name for side in others.sides_of(job)}
    assert "script_plain" in {side.name for side in others.sides_of(flat)}
    assert "script_same_look" not in {side.name for side in others.sides_of(flat)}


def test_a_script_that_dies_says_why(tmp_path):
    with (
        start_side("services.bench.baseline") as script,
        pytest.raises(MachineError, match=r"baseline ended.*No such file"),
    ):
        script.ask({"scene": str(tmp_path / "nothing.json"), "out": str(tmp_path), "look": "plain"})


def test_a_script_does_not_inherit_what_is_set_for_our_speed(monkeypatch):
    monkeypatch.setenv("OTHER", "kept")
    [(name, value)] = FOR_SPEED.items()
    ask = f"import json, os; print(json.dumps([os.environ.get({name!r}), os.environ['OTHER']]))"

    def seen_by_a_script() -> object:
        with start_side("script", [sys.executable, "-c", ask]) as script:
            return script.greeting

    monkeypatch.setenv(name, value)
    assert seen_by_a_script() == [None, "kept"]
    monkeypatch.setenv(name, "glibc.cpu.hwcaps=-AVX2")
    assert seen_by_a_script() == ["glibc.cpu.hwcaps=-AVX2", "kept"]


def test_what_is_not_installed_is_said_to_be_so():
    assert others.installed("numpy")
    assert others.installed("no-such-package-as-this") is None
    assert set(others.other_systems()) == {"MuJoCo", "Blender Cycles"}

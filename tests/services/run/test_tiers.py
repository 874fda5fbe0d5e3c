"""What a run says of a tier that is not installed."""

import importlib.util
import json
from pathlib import Path

import pytest

from services.cli.main import main


@pytest.mark.parametrize("more", [[], ["--dry-run"]])
def test_a_tier_that_is_not_installed_is_refused_before_anything_is_made(tmp_path, monkeypatch, capsys, more):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "mitsuba" else find_spec(name, *a)
    )
    job, out = tmp_path / "job.yaml", tmp_path / "out"
    job.write_text(json.dumps({"name": "t", "scenes": 1, "render": {"tier": "pathtraced"}}))
    assert main(["run", str(job), "--out", str(out), *more]) == 2
    told = capsys.readouterr().err
    assert "Mitsuba is not installed" in told and "./verso extra pathtraced" in told
    assert not Path(out).exists()


@pytest.mark.parametrize(("key", "value"), [("path_samples", 0), ("path_samples", "many"), ("path_bounces", 65)])
def test_a_count_of_paths_that_cannot_be_is_told_by_its_key(tmp_path, capsys, key, value):
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"name": "t", "render": {"tier": "pathtraced", key: value}}))
    assert main(["run", str(job), "--dry-run"]) == 2
    assert f"render.{key}: {value!r}" in capsys.readouterr().err


def test_a_tier_whose_system_library_is_missing_is_refused_with_the_package(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed: ./verso extra pathtraced")
    monkeypatch.setattr("workers.render.tiers.SYSTEM_LIBRARY", "libnone-of-this-name.so.1")
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"name": "t", "scenes": 1, "render": {"tier": "pathtraced"}}))
    assert main(["run", str(job), "--out", str(tmp_path / "out")]) == 2
    assert "apt-get install -y libatomic1" in capsys.readouterr().err

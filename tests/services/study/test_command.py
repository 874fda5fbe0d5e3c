"""`verso tradeoff` from the command line to the page: small, stopped and gone on with, and asked for what cannot be."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from schemas.errors import MachineError
from services.cli.main import main
from services.study import command, study
from services.study.study import JOURNAL_FILE
from tests.services.cli.test_main import TABLETOP, told
from tests.stored_studies import read_study

pytestmark = pytest.mark.minute

SMALL = [
    *("--scenes", "4", "--physics-scenes", "2", "--laps", "1", "--workers", "1", "--knobs", "step,units,splat"),
    *("--set", "cameras.sensor={width: 160, height: 120, fx: 131.25, fy: 131.25, cx: 80, cy: 60}"),
]


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """A small study, stopped half way and gone on with."""
    out = tmp_path_factory.mktemp("study")
    real, calls = study.time_scene, []

    def stopped(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "time_scene", stopped)
        assert main(["tradeoff", TABLETOP, "--out", str(out), *SMALL]) == 1
    kept = (out / JOURNAL_FILE).read_text()
    assert len(kept.splitlines()) == 1 + 2 and not (out / "tradeoff.parquet").exists()
    assert main(["tradeoff", TABLETOP, "--out", str(out), *SMALL]) == 0
    assert (out / JOURNAL_FILE).read_text().startswith(kept)
    return out


def test_the_table_has_every_setting_with_its_errors(measured):
    rows = {row["setting"]: row for row in pq.read_table(measured / "tradeoff.parquet").to_pylist()}
    assert {"the job", "step=60", "step=1920", "units=1000", "splat=3"} <= set(rows)
    assert rows["the job"]["ratio"] == 1.0
    assert all(row["ms"] > 0 for row in rows.values())


def test_coarser_depth_is_off_by_half_of_its_unit(measured):
    """99 % of even rounding errors are within 0.99 of half a unit: 0.1 mm and 0.5 mm."""
    errors = {row.setting.name: row.errors for row in read_study(measured).rows}
    assert errors["the job"]["depth_mm"].value == pytest.approx(0.1, rel=0.05)
    assert errors["units=1000"]["depth_mm"].value == pytest.approx(0.5, rel=0.05)
    assert errors["units=8000"]["depth_mm"].value == pytest.approx(0.0625, rel=0.05)


def test_a_larger_splat_fills_what_single_pixels_leave_empty(measured):
    errors = {row.setting.name: row.errors for row in read_study(measured).rows}
    assert errors["splat=3"]["unfilled_share"].value < 0.5 * errors["the job"]["unfilled_share"].value


def test_plots_and_the_page_are_there(measured):
    page = (measured / "index.html").read_text()
    assert "<html" in page and "units" in page and "1000" in page
    for name in ("tradeoff.png", "knob_step.png", "knob_units.png"):
        assert (measured / name).stat().st_size > 10_000


def test_the_same_command_measures_nothing_twice_and_says_the_same(measured, capsys):
    before = (measured / JOURNAL_FILE).read_bytes()
    errors = read_study(measured).rows
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL)
    assert code == 0 and "convergence" in text
    assert (measured / JOURNAL_FILE).read_bytes() == before
    assert read_study(measured).rows == errors


def test_a_target_writes_the_job_with_the_cheapest_setting_that_meets_it(measured, capsys, tmp_path, monkeypatch):
    assert main(["tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--target", "depth_mm=0.3", "--json"]) == 0
    answer = json.loads(
        capsys.readouterr().out.splitlines()[-1]
    )  # progress, where it is slow, goes to the other stream
    tree = yaml.safe_load((measured / "job.yaml").read_text())
    assert tree["name"] == "tabletop" and tree["cameras"]["sensor"]["width"] == 160
    for key, value in answer["changes"].items():
        place = tree
        for part in key.split("."):
            place = place[part]
        assert place == value
    assert main(["run", str(measured / "job.yaml"), "--dry-run"]) == 0


def test_a_target_that_nothing_meets_names_the_nearest_and_by_how_much_it_misses(measured, capsys):
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--target", "depth_mm=0.01")
    assert code == 1
    assert "units=8000" in text and "depth_mm" in text and "0.06" in text


def test_another_job_in_the_same_folder_is_refused(measured, capsys):
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(measured), *SMALL, "--set", "seed=5")
    assert code == 2 and "another study" in text and "--out" in text


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--knobs", "stepp"], 2, ["stepp", "did you mean 'step'"]),
        (["--target", "depth=0.1"], 2, ["depth", "depth_mm"]),
        (["--target", "depth_mm=near"], 2, ["near"]),
        (["--target", "depth_mm=-1"], 2, ["-1"]),
        (["--scenes", "1"], 2, ["1 scene", "--scenes"]),
        (["--set", "scenes=1"], 2, ["1 scene", "scenes: 1"]),
        (["--set", "physics.step_hz=1"], 2, ["physics.step_hz"]),
    ],
)
def test_bad_input_is_told_by_its_value_and_remedy_before_anything_is_measured(
    tmp_path, capsys, arguments, code, words
):
    found, text = told(capsys, "tradeoff", TABLETOP, "--out", str(tmp_path / "out"), *arguments)
    assert found == code
    for word in words:
        assert word in text
    assert not (tmp_path / "out").exists()


def test_a_tier_that_is_not_installed_is_told_with_how_to_install_it(tmp_path, capsys, monkeypatch):
    def missing(*_: object) -> None:
        raise MachineError("`./verso extra pathtraced` installs it")

    monkeypatch.setattr(command, "require_tier", missing)
    code, text = told(capsys, "tradeoff", TABLETOP, "--out", str(tmp_path / "o"), "--set", "render.tier=pathtraced")
    assert code == 1 and "./verso extra pathtraced" in text

"""`verify --audit`: what was left out is put back, and a difference is found and named."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import services.read.audit
import workers.scene.effects
import workers.scene.pairs
from schemas.dataset.layout import FINGERPRINT_FILE
from services.cli.main import main
from services.job.job_file import validate_job
from services.read import audit as audit_motion
from services.read.audit import Audit, Motion, audit, describe_audit
from services.read.referee import Held
from tests.datasets import run_here
from tests.effects.scenes import SMALL, merged
from workers.geometry.frames import translation
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.effects import EFFECTS, Effect
from workers.shard.fingerprint import take_fingerprint
from workers.store.local import LocalStore

JOB = validate_job(merged(SMALL, {"scenes": 4, "categories": ["can", "box"]}), "a test")


def dataset(out: Path) -> LocalStore:
    """Four scenes, made in this process."""
    return run_here(JOB, out)[0]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> LocalStore:
    return dataset(tmp_path_factory.mktemp("audit") / "small")


@pytest.fixture(autouse=True)
def no_referee(monkeypatch) -> None:
    """Holding a scene in MuJoCo takes seconds."""
    monkeypatch.setattr(services.read.audit, "is_installed", lambda: False)


@pytest.fixture
def calm() -> Iterator[None]:
    """Objects that stay where they are when they are released."""
    with released(0.0):
        yield


def released(by_m: float):
    """Every object moves along x by so much when it is released."""

    def release_again(plan, settled, physics, effects, seconds):
        assert effects.runs("dynamics") and effects.runs("table_mesh")
        assert seconds == 1.0
        return tuple(translation(by_m, 0.0, 0.0) @ rest.T_world_obj for rest in settled)

    return mock.patch.object(audit_motion, "release_again", release_again)


def run_audit(store: LocalStore, count: int = 4) -> Audit:
    return audit(store, count, lambda _: None)


@pytest.mark.usefixtures("calm")
def test_a_healthy_dataset_passes_and_each_effect_that_was_left_out_is_proven(made):
    found = run_audit(made)
    assert found.faults == []
    assert found.same_stack
    assert found.scenes == found.released == 4
    left_out = {name: tally.skipped for name, tally in found.effects.items() if tally.skipped}
    names = {"table_mesh", "object_contacts", "decomposition", "transparency", "exact_agreement"}
    assert left_out == dict.fromkeys(names, 4)
    assert all(tally.proven == tally.skipped for tally in found.effects.values())
    assert found.forced == 8
    assert found.bytes > 4 * 10_000 and found.files >= 4 * 20
    assert found.motion == Motion(0.0, 0.0, 0, 0)


def test_what_moves_within_the_bound_changes_masks_at_silhouettes_alone(made):
    with released(4e-5):
        found = run_audit(made)
    assert found.faults == []
    assert found.motion.moved_mm == pytest.approx(0.04, rel=1e-6)
    assert found.motion.turned_deg == 0.0
    assert found.motion.pixels_outside == 0


def test_what_moves_too_far_is_named_with_its_scene_effect_and_figure(made):
    with released(6e-5):
        found = run_audit(made, 1)
    assert len(found.faults) == 1
    assert "table_mesh: released with every effect, it moved 0.0600 mm, the bound is 0.05 mm" in found.faults[0]
    assert found.effects["table_mesh"].proven == 0
    assert found.effects["transparency"].proven == 1


@pytest.mark.usefixtures("calm")
def test_an_effect_that_was_left_out_wrongly_is_found_and_named(tmp_path):
    """The floor is left out of scenes that see it: putting it back changes their images."""

    def blind(effect: Effect) -> Effect:
        blinded = dataclasses.replace(effect, skipped_because=lambda _: "nobody looks")
        return blinded if effect.name == "floor" else effect

    with mock.patch.object(workers.scene.effects, "EFFECTS", tuple(map(blind, EFFECTS))):
        store = dataset(tmp_path / "blind")
        found = run_audit(store, 2)
    assert len(found.faults) == 2
    assert all(", floor: forced, it changes" in fault for fault in found.faults)
    assert found.effects["floor"].skipped == 2 and found.effects["floor"].proven == 0
    assert found.effects["transparency"].proven == 2


@pytest.mark.usefixtures("calm")
def test_a_scene_that_is_not_made_the_same_again_blames_no_effect(tmp_path):
    store = dataset(tmp_path / "other")
    with mock.patch.object(
        workers.scene.pairs, "quantise_depth", lambda depth, images: (depth * 4999).astype(np.uint16)
    ):
        write_fingerprint(store, {})
        found = run_audit(store, 1)
    assert ["made again with nothing forced, it differs" in fault for fault in found.faults] == [True]
    assert not any(tally.proven for name, tally in found.effects.items() if tally.kind == "no_op")


def write_fingerprint(store: LocalStore, changes: dict[str, str]) -> None:
    """This process's fingerprint, with changes, as the dataset's."""
    fingerprint = take_fingerprint(shared_renderer(), JOB.render.tier)
    store.put(FINGERPRINT_FILE, fingerprint.model_copy(update=changes).model_dump_json().encode())


@pytest.mark.usefixtures("calm")
def test_on_another_stack_the_forced_scene_is_held_against_a_plain_one(tmp_path):
    store = dataset(tmp_path / "foreign")
    for path in (tmp_path / "foreign").glob("*/RGB*.png"):
        path.write_bytes(b"what another stack made")
    write_fingerprint(store, {"canary": "0" * 64})
    found = run_audit(store, 2)
    assert not found.same_stack
    assert found.faults == []
    assert "because another stack" in "\n".join(describe_audit(found))


@pytest.mark.usefixtures("calm")
def test_where_mujoco_is_installed_it_holds_every_scene_and_else_a_line_says_so(made, monkeypatch):
    assert "MuJoCo is not installed" in "\n".join(describe_audit(run_audit(made, 1)))
    given = []

    def hold_scene(plan, settled, physics):
        given.append((len(plan.objects), len(settled), physics))
        return Held(0.125, 0.5, 1, {"as meshes, being convex": len(settled)})

    monkeypatch.setattr(services.read.audit, "is_installed", lambda: True)
    monkeypatch.setattr(services.read.audit, "hold_scene", hold_scene)
    found = run_audit(made, 2)
    assert given == [(1, 1, JOB.physics)] * 2 and found.faults == []
    assert found.held == Held(0.125, 0.5, 2, {"as meshes, being convex": 2})
    assert "MuJoCo held 2 scenes for 1 s: moved at most 0.1250 mm" in "\n".join(describe_audit(found))


def test_the_command_exits_1_and_lists_what_is_off(made, capsys):
    with released(1e-3):
        assert main(["verify", made.name, "--audit", "2", "--json"]) == 1
    lines = capsys.readouterr().out.splitlines()
    answer = json.loads(lines[-1])
    assert not answer["ok"] and answer["faults"] == []
    assert len(answer["audit"]["faults"]) >= 2
    assert answer["audit"]["effects"]["transparency"] == {"kind": "no_op", "skipped": 2, "proven": 2}
    assert any(line.startswith("audit of 2 scenes: 4 no-ops forced") for line in lines)
    with released(0.0):
        assert main(["verify", made.name, "--audit", "1"]) == 0

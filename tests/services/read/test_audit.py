"""`verify --audit`: what was left out is put back, and a difference is found and named."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from unittest import mock

import numpy as np
import pytest

import workers.scene.effects
import workers.scene.pairs
from schemas.dataset.layout import FINGERPRINT_FILE
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.view import Camera, Intrinsics, View
from services.cli.main import main
from services.job.job_file import validate_job
from services.read import audit as module
from services.read.audit import Audit, Motion, audit, compare_masks, describe_audit, move_between, shift_px
from tests.datasets import run_here
from tests.effects.scenes import SMALL, merged
from tests.kit.shapes import box, shape_of
from tests.workers.render.random_scenes import APPEARANCE, floor
from workers.geometry.frames import UP, pose, rotation_about, translation
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.effects import EFFECTS, Effect
from workers.shard.fingerprint import take_fingerprint
from workers.store.local import LocalStore

JOB = validate_job(merged(SMALL, {"scenes": 4, "categories": ["can", "box"]}), "a test")
TWO = JOB.model_copy(update={"scenes": 2})


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> LocalStore:
    """Four scenes, made in this process."""
    return run_here(JOB, tmp_path_factory.mktemp("audit") / "small")[0]


@contextlib.contextmanager
def released(by_m: float) -> Iterator[None]:
    """Every object moves along x by so much when it is released."""

    def release_again(plan, settled, physics, effects, seconds):
        assert effects.runs("dynamics") and effects.runs("table_mesh") and seconds == 1.0
        return tuple(translation(by_m, 0.0, 0.0) @ rest.T_world_obj for rest in settled)

    with mock.patch.object(module, "release_again", release_again):
        yield


def run_audit(store: LocalStore, count: int = 2, moved_m: float = 0.0) -> Audit:
    with released(moved_m):
        return audit(store, count, lambda _: None)


def test_what_a_studio_scene_has_no_use_for_is_not_forced(tmp_path):
    around = {"more": [{"name": "around", "ring": {"count": 2}}]}
    job = validate_job(merged(SMALL, {"scene": "studio", "scenes": 1, "cameras": around}), "a test")
    found = audit(run_here(job, tmp_path)[0], 1, lambda _: None)
    assert (found.faults, found.scenes, found.released) == ([], 1, 0)
    assert {name for name, tally in found.effects.items() if tally.proven} == {"transparency", "exact_agreement"}


def test_a_healthy_dataset_passes_and_each_effect_that_was_left_out_is_proven(made):
    found = run_audit(made, 4)
    assert found.faults == [] and found.same_stack and found.scenes == found.released == 4
    left_out = {name: tally.skipped for name, tally in found.effects.items() if tally.skipped}
    names = {"table_mesh", "object_contacts", "decomposition", "transparency", "exact_agreement"}
    assert left_out == dict.fromkeys(names, 4)
    assert all(tally.proven == tally.skipped for tally in found.effects.values())
    assert found.forced == 8 and found.bytes > 4 * 10_000 and found.files >= 4 * 20
    assert found.motion == Motion(0.0, 0.0, 0, 0)


def test_what_moves_too_far_is_named_and_within_the_bound_changes_masks_at_silhouettes_alone(made):
    found = run_audit(made, 4, moved_m=4e-5)
    assert found.faults == [] and found.motion.moved_mm == pytest.approx(0.04, rel=1e-6)
    assert (found.motion.turned_deg, found.motion.pixels_outside) == (0.0, 0)
    found = run_audit(made, 1, moved_m=6e-5)
    (fault,) = found.faults
    assert "table_mesh: released with every effect, it moved 0.0600 mm, the bound is 0.05 mm" in fault
    assert (found.effects["table_mesh"].proven, found.effects["transparency"].proven) == (0, 1)


def test_an_effect_that_was_left_out_wrongly_is_found_and_named(tmp_path):
    """The floor is left out of scenes that see it: putting it back changes their images."""

    def blind(effect: Effect) -> Effect:
        blinded = dataclasses.replace(effect, skipped_because=lambda _: "nobody looks")
        return blinded if effect.name == "floor" else effect

    with mock.patch.object(workers.scene.effects, "EFFECTS", tuple(map(blind, EFFECTS))):
        found = run_audit(run_here(TWO, tmp_path)[0])
    assert len(found.faults) == 2 and all(", floor: forced, it changes" in fault for fault in found.faults)
    assert (found.effects["floor"].skipped, found.effects["floor"].proven) == (2, 0)
    assert found.effects["transparency"].proven == 2


def write_fingerprint(store: LocalStore, changes: dict[str, str]) -> None:
    """This process's fingerprint, with changes, as the dataset's."""
    fingerprint = take_fingerprint(shared_renderer(), JOB.render.tier)
    store.put(FINGERPRINT_FILE, fingerprint.model_copy(update=changes).model_dump_json().encode())


@pytest.mark.minute
def test_on_another_stack_a_plain_scene_is_compared_and_a_scene_made_otherwise_blames_no_effect(tmp_path):
    store, _ = run_here(TWO, tmp_path)
    with mock.patch.object(workers.scene.pairs, "quantise_depth", lambda depth, _: (depth * 4999).astype(np.uint16)):
        write_fingerprint(store, {})
        found = run_audit(store, 1)
    assert ["made again with nothing forced, it differs" in fault for fault in found.faults] == [True]
    assert not any(tally.proven for tally in found.effects.values() if tally.kind == "no_op")
    for path in tmp_path.glob("*/RGB*.png"):
        path.write_bytes(b"what another stack made")
    write_fingerprint(store, {"canary": "0" * 64})
    found = run_audit(store)
    assert not found.same_stack and found.faults == []
    assert "because another stack" in "\n".join(describe_audit(found))


def test_the_command_exits_1_and_lists_what_is_off(made, capsys):
    with released(1e-3):
        assert main(["verify", made.name, "--audit", "2", "--json"]) == 1
    lines = capsys.readouterr().out.splitlines()
    answer = json.loads(lines[-1])
    assert not answer["ok"] and answer["faults"] == [] and len(answer["audit"]["faults"]) >= 2
    assert answer["audit"]["effects"]["transparency"] == {"kind": "no_op", "skipped": 2, "proven": 2}
    assert any(line.startswith("audit of 2 scenes: 4 no-ops forced") for line in lines)
    with released(0.0):
        assert main(["verify", made.name, "--audit", "1"]) == 0


# ------------------------------------------------------------------------------- motions and changed mask pixels


def test_a_turn_and_a_shift_are_measured_exactly_however_small():
    shape = shape_of(box(0.2, 0.2, 0.2))
    turn = pose(rotation_about(UP, np.radians(1e-5)), np.zeros(3))
    motion = move_between(shape, np.eye(4), turn)
    assert motion.turned_deg == pytest.approx(1e-5, rel=1e-6)
    assert motion.moved_mm == pytest.approx(np.radians(1e-5) * 0.1 * np.sqrt(2) * 1e3, rel=1e-6)
    assert move_between(shape, turn, translation(0.0, 3e-5, 4e-5) @ turn).moved_mm == pytest.approx(0.05, rel=1e-6)


# A camera 1 m above a box of 20 cm; a pixel is 1 mm on its top, 0.9 m away.
LOOKS_DOWN = Camera(
    Intrinsics(width=320, height=240, fx=900.0, fy=900.0, cx=160.3, cy=120.2),
    pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0])),
)


def seen_box(x_m: float = 0.0) -> PosedScene:
    return PosedScene((floor(), Placed(3, shape_of(box(0.2, 0.2, 0.2)), translation(x_m, 0.0, 0.0))), APPEARANCE)


def test_pixels_that_a_moved_box_uncovers_lie_within_its_motion_and_others_are_counted():
    before, after, renderer = seen_box(), seen_box(0.0013), shared_renderer()
    assert shift_px(before.things[1], after.things[1], LOOKS_DOWN) == pytest.approx(1.3, rel=1e-6)
    seen = renderer.draw(before.things, before.appearance, LOOKS_DOWN)
    view = View("input", 0, 0, LOOKS_DOWN, seen.rgb, seen.depth_m.astype(np.uint16), seen.region, ())
    changed, outside = compare_masks(renderer, before, after, view)
    assert changed >= 2 * 200 and outside == 0
    region = seen.region.copy()
    region[120, 150:157] = 1
    assert compare_masks(renderer, before, before, dataclasses.replace(view, region=region)) == (7, 7)

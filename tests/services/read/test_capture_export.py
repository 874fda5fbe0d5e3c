from pathlib import Path

import pytest

from schemas.errors import CorruptError
from services.read.dataset_reader import find_scene
from services.read.scene_geometry import captured_geometry
from tests.captures import captures_job, use_exact_captures
from tests.datasets import run_here


def test_a_shape_that_is_lost_or_damaged_is_named_with_the_remedy(tmp_path, monkeypatch):
    use_exact_captures(monkeypatch)
    store, _ = run_here(captures_job(scenes=1), tmp_path)
    stored = find_scene(store, 0)
    (shape,) = Path(tmp_path).glob("assets/mug/*.glb")
    shape.write_bytes(b"glTF")
    with pytest.raises(CorruptError, match="--repair"):
        list(captured_geometry(store, stored, stored.scene(0)))
    shape.unlink()
    with pytest.raises(CorruptError, match=shape.name):
        list(captured_geometry(store, stored, stored.scene(0)))

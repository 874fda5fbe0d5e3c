"""Paths of a view's images, by its row."""

from services.read.stored_tables import patch_paths, view_paths

ROW = {"category": "mug", "role": "aligned", "pose_id": 12}


def named(*paths: str) -> dict:
    return {**ROW, "files": [{"path": path} for path in paths]}


def test_only_images_that_are_stored_have_a_path():
    both = named("mug/depthAligned00012.png", "mug/patches/depthAligned00012.png", "mug/RGB00012.png")
    assert view_paths(both) == {"depth": "mug/depthAligned00012.png"}
    assert patch_paths(both, None) == {"depth": "mug/patches/depthAligned00012.png"}
    assert patch_paths(both, 1) == {}
    assert patch_paths(named("mug/patches/depthAligned00012obj1.png"), 1) == {
        "depth": "mug/patches/depthAligned00012obj1.png"
    }

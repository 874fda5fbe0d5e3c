"""One set of functions for all kinds of sources."""

import pytest

from schemas.errors import MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits, ProceduralSource
from tests.workers.assets.oracles import CUBE, write
from workers.assets.sources import count_instances, list_source, load_instance, name_instance

BUILT_IN = ProceduralSource(source="procedural", seed=4, instances=7)


def test_built_in_shapes_need_no_listing_and_have_every_category(tmp_path):
    assert list_source(BUILT_IN, tmp_path / "nowhere", ("mug",), MeshLimits()) is None
    assert count_instances(BUILT_IN, None, "mug") == count_instances(BUILT_IN, None, "table") == 7
    name = name_instance(BUILT_IN, None, "mug", 3)
    assert name == "mug-4-000003"
    assert load_instance(BUILT_IN, None, "mug", 3, Assets()).instance_id == name


def test_a_folder_has_what_its_listing_says_and_loads_it_unless_it_has_changed(tmp_path):
    path = write(tmp_path / "a.obj", CUBE)
    settings = FolderSource(source="urdf", folder=".", category_map={"*.obj": "mug"})
    listing = list_source(settings, tmp_path, ("mug", "can"), MeshLimits())
    assert [count_instances(settings, listing, category) for category in ("mug", "can")] == [1, 0]
    assert load_instance(settings, listing, "mug", 0, Assets()).instance_id == name_instance(
        settings, listing, "mug", 0
    )
    write(path, CUBE + "#")
    with pytest.raises(MeshError, match="changed"):
        load_instance(settings, listing, "mug", 0, Assets())

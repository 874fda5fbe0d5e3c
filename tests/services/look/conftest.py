"""What the tests of the report share: a small dataset, which none changes, tables made by hand, and scenes without one."""

import math
import shutil

import numpy as np
import pyarrow as pa
import pytest

from schemas.dataset.tables import SCHEMAS
from services.look.collect import collect
from services.look.pictures import Picture, ShownScene, picture_of_colour
from services.read.dataset_reader import StoredTables
from tests.datasets import make_dataset
from workers.store.local import LocalStore

HOSTILE = '"><script>alert("&")</script>'


@pytest.fixture(scope="package")
def shown(files, tmp_path_factory) -> LocalStore:
    """Four finished scenes of two categories, whose commits may be given other times."""
    return LocalStore(shutil.copytree(files.root, tmp_path_factory.mktemp("shown") / "shown"))


def scene(scene_id: int, category: str, names=("input rgb", "mirror rgb", "over")) -> ShownScene:
    picture = picture_of_colour(np.zeros((12, 16, 3), np.uint8), "input view, colour")
    visible = {"input": 0.98, "mirror": None}
    return ShownScene(scene_id, category, ("a", "b"), 2 * scene_id, dict.fromkeys(names, picture), visible, 2.345678)


def address(picture: Picture) -> str:
    return f"/picture/{picture.name}"


SCENES = [
    {"scene_id": 0, "category": "mug", "effects": ["drop", "rgb"],
     "skipped": [{"effect": "glass", "why": "no glass"}]},
    {"scene_id": 1, "category": "mug", "effects": ["drop"],
     "skipped": [{"effect": "glass", "why": "no glass"}, {"effect": "rgb", "why": "off"}]},
    {"scene_id": 3, "category": "box", "effects": ["drop", "rgb"],
     "skipped": [{"effect": "glass", "why": "not asked"}]},
]  # fmt: skip
FILES = [{"bytes": 100, "path": "a", "sha256": "0"}, {"bytes": 50, "path": "b", "sha256": "0"}]
VIEWS = [
    {"role": "input", "visible_fraction": 0.5, "inclination_rad": math.radians(45), "d_z_m": 2.5, "files": FILES},
    {"role": "mirror", "visible_fraction": 1.0, "inclination_rad": math.radians(40), "d_z_m": 2.5, "files": FILES[:1]},
    {"role": "input", "visible_fraction": None, "inclination_rad": math.radians(47), "d_z_m": 2.1, "files": []},
    {"role": "projected", "visible_fraction": None, "inclination_rad": 0.7, "d_z_m": 2.1, "files": FILES},
]
TIMINGS = [
    {"stages": [{"name": "physics", "seconds": 1.5}], "effects": [{"name": "drop", "seconds": 1.0}], "total_s": 2.0},
    {"stages": [{"name": "physics", "seconds": 0.5}, {"name": "render", "seconds": 4.0}], "total_s": 5.0,
     "effects": [{"name": "drop", "seconds": 0.25}]},
]  # fmt: skip
FAILED = {"category": "mug", "kind": "intrinsic", "attempts": 1, "stage": "settle"}
FAILURES = [
    {"scene_id": 2, "reason": "left_table", "detail": "at 0.7 m", **FAILED},
    {"scene_id": 5, "reason": "no_rest", "detail": "moved", **FAILED},
    {"scene_id": 4, "reason": "left_table", "detail": "at 0.8 m", **FAILED},
]
ASSETS = [
    {"instance_id": name, "category": category}
    for name, category in map(str.split, ("a mug", "t table", "a mug", "b box"))
]


class Handmade(StoredTables):
    """Tables of these rows, whose other columns are null."""

    def __init__(self, **tables) -> None:
        self.store, self.sampled, self.rows = LocalStore("handmade"), False, tables

    def parts(self, table):
        schema = pa.schema([field.with_nullable(True) for field in SCHEMAS[table]])
        rows = [dict.fromkeys(schema.names) | row for row in self.rows.get(table, [])]
        return [pa.Table.from_pylist(rows, schema)]


@pytest.fixture(scope="package")
def figures():
    return collect(Handmade(scenes=SCENES, views=VIEWS, timings=TIMINGS, failures=FAILURES, assets=ASSETS))


@pytest.fixture(scope="package")
def studio(tmp_path_factory) -> LocalStore:
    """A finished studio scene with a ring, cameras all over a sphere, and one beside the input camera."""
    cameras = {
        "sensor": {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0},
        "more": [
            {"name": "around", "ring": {"count": 14, "inclination_rad": 0.4}},
            {"name": "over", "sphere": {"count": 5, "pattern": "fibonacci"}},
            {"name": "right", "beside": "input", "offset_m": [0.1, 0.0, 0.0]},
        ],
    }
    changes = {
        "scene": "studio",
        "studio": {"scale": "unit_sphere"},
        "scenes": 1,
        "categories": ["mug"],
        "images": {"patch": {"width": 8, "height": 6}},
    }
    return make_dataset(tmp_path_factory.mktemp("studio"), cameras=cameras, check={"raycast_share": 0.0}, **changes)[0]


@pytest.fixture(scope="package")
def targets(tmp_path_factory) -> LocalStore:
    """A finished scene of two objects with every image target."""
    changes = {"scenes": 1, "objects_per_scene": 2, "categories": ["mug"], "start": {"offset_m": [-0.12, 0.12]}}
    images = {"views": ["normals", "coordinates", "albedo", "covisible", "amodal", "layers"], "layers": 2}
    return make_dataset(tmp_path_factory.mktemp("targets"), targets=images, **changes)[0]

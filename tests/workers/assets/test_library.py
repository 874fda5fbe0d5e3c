"""Libraries of shapes: decided once, made when they are asked for, edited by hand, and what is wrong with one in a line."""

import pickle
import time
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.errors import AssetSourceError, InUseError, MeshError, OutputError
from schemas.job.assets import BUILT_IN, Assets, LibrarySource, MeshLimits
from tests.workers.assets.libraries import library_of, open_folder
from tests.workers.door.oracles import CUBE, picture, textured_cube, write
from workers.assets.catalogue import choose_object, open_catalogue
from workers.assets.library import collection, making, shapes, table
from workers.assets.library.making import (
    Making,
    decide_rows,
    locate_folder,
    locked,
    make_library,
    open_library,
    remake_library,
)
from workers.assets.library.reading import load_file, place_asset
from workers.assets.library.shapes import load_shape, make_shapes, open_shape, shape_path, with_shape
from workers.assets.library.table import SCHEMA, TABLE_FILE, read_table, write_table

TALL = CUBE.replace("v 0 1", "v 0 3").replace("v 1 1", "v 1 3")  # 1 x 3 x 1: +Y is up
SETTINGS = LibrarySource(source="library", folder=".")


USUAL = Making()


def init(source, out, how=USUAL):
    """The table as `verso init` writes it."""
    with locked(out, wait=False):
        return remake_library(source, out, how)


def made(folder, **how):
    """A library beside a folder, with all its shapes."""
    library = init(folder, folder.parent / "lib", Making(**how))
    rows = {row.path: with_shape(library, row, shape) for row, shape in make_shapes(library, _used(library))}
    library = replace(library, rows=tuple(rows.get(row.path, row) for row in library.rows))
    write_table(library)
    return library


def _used(library):
    return [row for row in library.rows if row.use and row.category]


def load(library, row, settings=SETTINGS, **assets):
    return load_shape(library, row, settings, Assets(**assets), row.instance_id)


def test_a_shape_comes_back_from_its_glb_as_it_was_but_for_the_rounding_of_float32(tmp_path):
    textured_cube(tmp_path / "in")
    write(tmp_path / "in/skin.png", picture(colour=None))
    library = made(tmp_path / "in", units=(("*", 0.1),), up="y")
    (row,) = library.rows
    read = load_file(tmp_path / "in", tmp_path / "in/cube.obj", MeshLimits())
    there, here = load(library, row), place_asset(read, row, MeshLimits())
    assert (there.scale, there.notes, there.watertight) == (0.1, here.notes, True)
    assert there.mass.mass_kg == here.mass.mass_kg and (there.mass.inertia == here.mass.inertia).all()
    assert (there.T_source_to_object == here.T_source_to_object).all() and there.sha256 == row.sha256
    for one, two in zip(there.shape.parts, here.shape.parts, strict=True):
        assert (one.vertices == two.vertices.astype(np.float32)).all() and (one.faces == two.faces).all()
        assert (one.material.texture == two.material.texture).all()
        assert one.material.base_color == pytest.approx(two.material.base_color, abs=1e-12)
        assert np.abs(one.uv - two.uv).max() < 1e-6 and not one.vertices.flags.writeable
    small = load(library, row, SETTINGS.model_copy(update={"diagonal_m": 0.05}), density_kg_m3=1200.0)
    factor = 0.05 / float(np.linalg.norm(there.extents_m))
    assert float(np.linalg.norm(small.extents_m)) == pytest.approx(0.05)
    assert small.mass.mass_kg == pytest.approx(2.0 * factor**3 * there.mass.mass_kg)
    assert small.mass.inertia == pytest.approx(2.0 * factor**5 * there.mass.inertia)
    assert small.volume_m3 == pytest.approx(factor**3 * there.volume_m3)


def test_what_a_person_edits_stays_when_the_folder_is_read_again_and_a_changed_source_is_noticed(tmp_path):
    for name in ("mug/1.obj", "mug/2.obj", "mug/3.obj"):
        write(tmp_path / "in" / name, TALL + "#" * ord(name[4]))
    library = made(tmp_path / "in")
    path = library.folder / TABLE_FILE
    rows = pq.read_table(path).to_pylist()
    rows[0] |= {"up": "y", "unit": 0.1, "category": "beaker"}
    rows[1] |= {"use": False}
    pq.write_table(pa.Table.from_pylist(rows), path)  # as other programs write: without what stands beside the columns
    write(tmp_path / "in/mug/3.obj", CUBE)
    again = made(tmp_path / "in")
    a, b, c = again.rows
    assert (a.up, a.unit, a.category) == ("y", 0.1, "beaker") and load(again, a).extents_m[2] == pytest.approx(0.3)
    assert (b.use, b.reason) == (False, "edited") and c.sha256 != library.rows[2].sha256
    assert again.rows == made(tmp_path / "in").rows == read_table(again.folder).rows
    assert {row.category for row in _used(again)} == {"beaker", "mug"}


def test_a_run_on_a_folder_makes_its_library_in_the_cache_and_reads_again_only_what_moved(tmp_path, monkeypatch):
    monkeypatch.setattr(making, "cache_folder", lambda name: tmp_path / "cache" / name)
    mug = write(tmp_path / "in/mug/a.obj", TALL)
    asked = []
    ask = collection.ask
    monkeypatch.setattr(collection, "ask", lambda questions, limits: ask(asked.extend(questions) or asked[:], limits))

    def opened():
        asked.clear()
        library = open_library("in", tmp_path)
        return library.digest, len(asked)

    digest, count = opened()
    assert count == 1 and opened() == (digest, 0)
    mug.touch()
    assert opened() == (digest, 0), "its time moved, and its bytes did not"
    write(mug, CUBE)
    other, count = opened()
    assert count == 1 and other != digest
    (cache,) = (tmp_path / "cache/libraries").glob("*/*/library.parquet")
    assert read_table(cache.parent).source == tmp_path / "in"
    write(tmp_path / "in/mug/b.obj", "mtllib b.mtl\nusemtl x\n" + CUBE)
    write(tmp_path / "in/mug/b.mtl", "newmtl x\nmap_Kd gone.png\n")
    with_note, _ = opened()
    write(tmp_path / "in/mug/gone.png", picture())
    assert opened()[0] != with_note, "what was missing and has come is seen"


def test_a_shape_is_made_when_it_is_first_asked_for_and_one_that_is_refused_is_drawn_again(tmp_path):
    mugs = tmp_path / "net" / str(BUILT_IN["mug"].synset)
    for name, text in (("a", TALL), ("b", "v 0 0 0\n"), ("c", TALL + "#")):
        write(mugs / name / "models/model_normalized.obj", text)
    write(mugs / "d/model.obj", TALL + "##")  # version 1
    (mugs / "e").mkdir()
    source = LibrarySource(source="library", folder="net")
    catalogue = open_catalogue(Assets(objects=(source,)), tmp_path, ("mug",))
    (library,) = catalogue.libraries()
    assert not any(shape_path(library, row).exists() for row in library.rows) and library.count("mug") == 4
    assert catalogue.objects[0].skipped == {"missing": 1}
    drawn = {choose_object(catalogue, "mug", np.random.default_rng(seed)).instance_id for seed in range(40)}
    assert drawn == {f"03797390-{name}" for name in "acd"}
    asset = catalogue.load(choose_object(catalogue, "mug", np.random.default_rng(0)))
    assert asset.extents_m == pytest.approx([0.25, 0.25, 0.75]) and "non-commercial" in asset.licence
    # A point at the front of the model, -Z, has +y here; one above has +z.
    front, above = (asset.T_source_to_object[:3, :3] @ axis for axis in (np.array([0, 0, -1]), np.array([0, 1, 0])))
    assert front == pytest.approx([0, 1, 0]) and above == pytest.approx([0, 0, 1])
    write(mugs / "a/models/model_normalized.obj", "v 0 0 0\n")
    for name in "cd":
        (mugs / name).rename(tmp_path / name)
    again = open_catalogue(Assets(objects=(source,)), tmp_path, ("mug",))
    with pytest.raises(MeshError, match=r"none of .* can be made"):
        choose_object(again, "mug", np.random.default_rng(0))


def test_pybullet_data_is_the_package_with_rules_of_its_own(tmp_path):
    assert locate_folder("things", tmp_path) == tmp_path / "things"
    library = open_library("pybullet_data", tmp_path)
    assert {category: len(rows) for category, rows in library.entries.items()}.items() >= {("mug", 1), ("table", 2)}
    tables = [load(library, row) for row in library.entries["table"]]
    # table.urdf: a top of 1.5 x 1 x 0.05 m whose middle is at 0.6 m, on legs that reach down to 0.
    assert tables[0].extents_m == pytest.approx([1.5, 1.0, 0.625]) and tables[0].watertight
    mug = load(library, library.entries["mug"][0])
    assert mug.extents_m[2] == pytest.approx(0.1, abs=1e-3)
    assert mug.shape.parts[0].material.base_color == pytest.approx((1.0, 0.2, 0.2, 1.0))


def test_a_library_without_its_source_is_used_and_a_shape_that_is_gone_or_changed_is_told_in_a_line(tmp_path):
    for name in "ab":
        write(tmp_path / "in/mug" / f"{name}.obj", TALL + "#" * ord(name))
    library = made(tmp_path / "in")
    before = [load(library, row).shape.vertices.tobytes() for row in library.rows]
    path = shape_path(library, library.rows[0])
    whole = path.read_bytes()
    for damage in (whole[:-5], whole[:-5] + b"12345", None):  # healed, as long as its source is there
        path.unlink() if damage is None else path.write_bytes(damage)
        assert load(library, library.rows[0]).shape.vertices.tobytes() == before[0] and path.read_bytes() == whole
    (tmp_path / "in").rename(tmp_path / "away")
    opened = open_library("lib", tmp_path)
    assert [load(opened, row).shape.vertices.tobytes() for row in opened.rows] == before
    path.write_bytes(whole[:-5] + b"12345")
    with pytest.raises(MeshError, match=r"is not what library.parquet says.*verso init") as caught:
        open_shape(opened, opened.rows[0])
    assert pickle.loads(pickle.dumps(caught.value)).kind == "environmental"
    for damage, says in ((whole[:-5], "is not what library.parquet says"), (None, "is missing")):
        path.unlink() if damage is None else path.write_bytes(damage)
        with pytest.raises(AssetSourceError, match=says) as refusal:
            open_library("lib", tmp_path)
        assert "\n" not in str(refusal.value)


NONSENSE: tuple[tuple[dict[str, object], str], ...] = (
    ({"up": "w"}, "a.obj: up 'w': must be x, y or z"),
    ({"unit": -1.0}, "unit -1.0: must be a positive number"),
    ({"unit": float("nan")}, "must be a positive number"),
    ({"use": None}, "use None: must be true or false"),
    ({"category": "a/b"}, "category 'a/b': must be letters"),
    ({"path": "../x.obj"}, "must lie below the source's folder"),
    ({"licence": ""}, "licence '': must be some words"),
    ({"library": "x"}, "is no table of a library"),
    ({"library": '{"version": 9, "folder": "/", "limits": {}}'}, "is of version 9, and this program reads 1"),
    ({"faces": "many"}, "is no table of a library"),
    ({"files": []}, "must begin with path"),
)


def test_a_table_that_makes_no_sense_is_told_in_a_line(tmp_path):
    write(tmp_path / "in/mug/a.obj", TALL)
    library = made(tmp_path / "in")
    path = library.folder / TABLE_FILE
    (row,) = pq.read_table(path).to_pylist()
    tables = [(pa.Table.from_pylist([{**row, **change}]), says) for change, says in NONSENSE]
    tables += [(pa.Table.from_pylist([row, row]), "has two rows"), (SCHEMA.empty_table(), "it has no row")]
    tables += [(pa.Table.from_pylist([row]).drop(["unit"]), "it has no column unit")]
    for nonsense, says in tables:
        pq.write_table(nonsense, path)
        with pytest.raises(AssetSourceError, match=says) as refusal:
            read_table(library.folder)
        assert "\n" not in str(refusal.value) and str(path) in str(refusal.value)
    path.write_bytes(b"PAR1 and no more")
    with pytest.raises(AssetSourceError, match="is no table of a library"):
        read_table(library.folder)


def test_two_makers_of_a_library_a_full_disk_and_a_folder_that_changes_are_told_and_leave_nothing(
    tmp_path, monkeypatch
):
    def full(*_):
        raise OSError(28, "No space left on device")

    write(tmp_path / "in/mug/a.obj", TALL)
    with locked(tmp_path / "lib", wait=False), pytest.raises(InUseError, match="another `verso init`"):
        init(tmp_path / "in", tmp_path / "lib")
    with monkeypatch.context() as patch:
        patch.setattr(table.Path, "write_bytes", full)
        with pytest.raises(OutputError, match=r"library.parquet cannot be written: No space"):
            init(tmp_path / "in", tmp_path / "new")
        assert not (tmp_path / "new").exists()
        library = make_library(tmp_path / "in", tmp_path / "cache", Making())  # a run goes on without
        assert load(library, library.rows[0]).watertight
        with pytest.raises(OutputError, match=r"\.glb cannot be written: No space"):
            list(make_shapes(library, library.rows, must_keep=True))
    library = init(tmp_path / "in", tmp_path / "lib")
    write(tmp_path / "in/mug/a.obj", CUBE)
    ((_, answer),) = make_shapes(library, library.rows)
    assert (answer.reason, answer.kind) == ("changed", "environmental") and "verso init" in answer.detail


def test_a_large_collection_is_listed_and_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(making, "MOST_READ", 20)
    monkeypatch.setattr(making, "SAMPLE", 10)
    for k in range(200):
        path = tmp_path / "in" / f"mug_{k // 100}" / f"{k}.obj"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(TALL + "#" * k)
    rows = decide_rows(tmp_path / "in", Making())
    assert len(rows) == 200 and len({row.unit for row in rows}) == 1 and len({row.instance_id for row in rows}) == 200
    assert all(row.files[0].sha256 == "" and "files that were read" in row.why for row in rows)
    catalogue = open_folder(tmp_path / "in", units=(), up=None)
    asset = catalogue.load(choose_object(catalogue, "mug", np.random.default_rng(0)))
    assert len(asset.sha256) == 64 and len(list((tmp_path / "in_library/shapes").iterdir())) == 1


def test_what_is_found_out_of_files_costs_no_second_process_and_answers_that_were_cut_are_asked_again(tmp_path):
    library_of(write(tmp_path / "in/a.obj", "v 0 0 0\n").parent)
    folder = tmp_path / "net" / str(BUILT_IN["mug"].synset)
    write(folder / "a/model.obj", "v 0 0 0\n")
    library = open_library("net", tmp_path)
    for _ in range(2):
        with pytest.raises(MeshError, match="no_faces"):
            open_shape(library, library.rows[0])
    kept = library.folder / shapes.REFUSED
    begun = time.monotonic()
    whole = kept.read_bytes()
    kept.write_bytes(whole[:-3])
    with pytest.raises(MeshError, match="no_faces"):
        open_shape(library, library.rows[0])
    assert len(kept.read_bytes()) > len(whole) - 3 and time.monotonic() - begun < 60

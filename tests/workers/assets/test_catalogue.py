"""The catalogue: what it lists, chooses and loads, and the cache of assets that keeps within its memory."""

import pickle
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import CATEGORIES, Assets, LibrarySource, ProceduralSource, SplitShares
from services.job.job_file import validate_job
from tests.kit.shapes import asset_of
from tests.workers.door.oracles import CUBE, textured_obj, write, write_all
from workers.assets import catalogue as catalogue_file
from workers.assets.catalogue import (
    Catalogue,
    asset_bytes,
    choose_object,
    choose_table,
    load_asset,
    open_cache,
    open_catalogue,
)
from workers.capture.results import open_sources

BUILT_IN = ProceduralSource(source="procedural")
REPOSITORY = Path(__file__).resolve().parents[3]


def folder(name="things", **more):
    return LibrarySource(source="library", folder=name, **more)


def opened(tmp_path, *objects, tables=(BUILT_IN,), categories=("mug",)):
    return open_catalogue(Assets(objects=objects or (BUILT_IN,), tables=tuple(tables)), tmp_path, categories)


def mugs(tmp_path, count, start=0):
    """Cubes called mug/0.obj and so on, whose bytes differ."""
    return [write(tmp_path / "things/mug" / f"{k}.obj", CUBE + "#" * k) for k in range(start, count)]


def test_built_in_shapes_need_no_folder_and_have_every_category(tmp_path):
    few = BUILT_IN.model_copy(update={"seed": 4, "instances": 7})
    catalogue = opened(tmp_path / "nowhere", few, tables=(few,), categories=CATEGORIES)
    for category in CATEGORIES:
        ref = choose_object(catalogue, category, np.random.default_rng(0))
        asset = load_asset(catalogue, ref)
        assert (asset.category, asset.instance_id) == (category, ref.instance_id)
    assert load_asset(catalogue, choose_table(catalogue, np.random.default_rng(0))).category == "table"
    assert catalogue.offers("mug") == catalogue.offers("table") == [(0, few, 7)]
    assert catalogue.load(catalogue.refer(0, "mug", 3)).instance_id == "mug-4-000003"


def test_sources_are_mixed_by_weight_and_instances_evenly_by_draws_that_are_the_same_again(tmp_path):
    mugs(tmp_path, 3)
    catalogue = opened(tmp_path, folder(weight=3.0), BUILT_IN, categories=("mug", "can"))
    one, two = np.random.default_rng(0), np.random.default_rng(0)
    refs = [choose_object(catalogue, "mug", one) for _ in range(4000)]
    assert refs == [choose_object(catalogue, "mug", two) for _ in range(4000)] and one.random() == two.random()
    from_folder = [ref.index for ref in refs if ref.source == 0]
    # A binomial of 4000 draws at 3/4 has a standard deviation of 27.
    assert len(from_folder) == pytest.approx(3000, abs=5 * 27)
    assert np.bincount(from_folder) == pytest.approx(np.full(3, 1000), abs=5 * 27)
    assert {choose_object(catalogue, "can", one).source for _ in range(50)} == {1}, "the other source has none"


REFUSED = (
    ((folder(),), ("mug", "can"), r"no source in assets.objects offers 'can'.*has 4 mug.*source: procedural"),
    ((folder("nowhere"),), ("mug",), "nowhere is not a folder"),
    ((folder("net"),), ("mug", "box"), "ShapeNetCore has no box"),
    ((folder("broken"),), ("mug",), r"none of 2 meshes for 'mug' in .*mug/0.obj \(no_faces: "),
    ((folder("~nobody7/x"),), ("mug",), "no such user"),
    ((BUILT_IN, BUILT_IN.model_copy(update={"size": "metric"})), ("mug",), "the seed 0 and different sizes"),
)


def test_what_cannot_be_offered_is_refused_with_what_was_found_and_a_remedy(tmp_path):
    mugs(tmp_path, 4)
    write(tmp_path / "net" / "03797390" / "a" / "model.obj", CUBE)
    for name in ("0.obj", "1.obj"):
        write(tmp_path / "broken/mug" / name, "v 0 0 0\n")
    for objects, categories, says in REFUSED:
        with pytest.raises(AssetSourceError, match=says):
            opened(tmp_path, *objects, categories=categories)
    with pytest.raises(AssetSourceError, match=r"no source in assets.tables offers 'table'.*library that has tables"):
        opened(tmp_path, tables=(folder(),))
    assert opened(tmp_path, folder("net"), BUILT_IN, categories=("mug", "box"))
    assert opened(tmp_path, BUILT_IN, BUILT_IN.model_copy(update={"size": "metric", "seed": 1}))


@pytest.mark.parametrize(
    ("keys", "message"),
    [({"assets": {"density_kg_m3": {"vasee": 900.0}}}, "assets.density_kg_m3.vasee: .* did you mean 'vase'"),
     ({"physics": {"friction": {"table": 0.4, "vasee": 0.6}}}, "physics.friction.vasee: .* did you mean 'vase'"),
     ({"assets": {"density_kg_m3": {"vase": 900.0}}, "physics": {"friction": {"table": 0.4, "vase": 0.6}}}, "")],
)  # fmt: skip
def test_a_map_by_category_has_names_that_the_libraries_offer(tmp_path, keys, message):
    write(tmp_path / "things/vase/0.obj", CUBE)
    assets = {"objects": [{"source": "library", "folder": "things"}], **keys.get("assets", {})}
    job = validate_job({"name": "x", "categories": ["vase"], **keys, "assets": assets}, "x")
    with pytest.raises(AssetSourceError, match=message) if message else nullcontext():
        open_sources(job, tmp_path)


def test_a_bad_mesh_among_good_ones_is_never_drawn_and_moves_no_other_draw(tmp_path):
    paths = mugs(tmp_path, 4)
    before = opened(tmp_path, folder())
    first = [choose_object(before, "mug", np.random.default_rng(seed)) for seed in range(200)]
    write(paths[2], "v 0 0 0\n")
    after = opened(tmp_path, folder())
    assert [catalogue.objects[0].skipped for catalogue in (before, after)] == [{}, {"no_faces": 1}]
    assert [catalogue.offers("mug")[0][2] for catalogue in (before, after)] == [4, 3]
    assert before.digest != after.digest and before.offers("can") == []
    draws = []
    for seed, one in enumerate(first):
        two = choose_object(after, "mug", np.random.default_rng(seed))
        assert two == one or one.index == 2
        draws.append(two.index)
    # A binomial of 200 draws at 1/3 has a standard deviation of 6.7.
    counts = np.bincount(draws, minlength=4)
    assert counts[2] == 0 and counts[[0, 1, 3]] == pytest.approx(np.full(3, 200 / 3), abs=5 * 6.7)
    assert load_asset(after, after.refer(0, "mug", 1)).watertight


def test_the_digest_knows_every_byte_setting_and_category_but_not_where_the_folder_lies(tmp_path):
    def digest(name="things", text=CUBE, skin=b"png", **more):
        write_all(tmp_path / name, textured_obj())
        write(tmp_path / name / "mug/mug.obj", "mtllib ../cube.mtl\n" + text)
        write(tmp_path / name / "skin.png", skin)
        return opened(tmp_path, folder(name, **more)).digest

    same = digest()
    assert digest() == digest("elsewhere") == same
    others = [digest(text=CUBE + "#"), digest(skin=b"pnG"), digest(diagonal_m=2.0), digest(weight=2.0)]
    others += [opened(tmp_path).digest, opened(tmp_path, categories=("mug", "can")).digest]
    changes = {"seed": 1}, {"instances": 7}
    others += [opened(tmp_path, BUILT_IN.model_copy(update=change)).digest for change in changes]
    assert len({same, *others}) == 1 + len(others)


@pytest.mark.minute
def test_an_opened_catalogue_travels_small_and_loads_the_same_asset_in_another_process(tmp_path):
    catalogue = opened(tmp_path)
    ref = choose_object(catalogue, "mug", np.random.default_rng(3))
    data = write(tmp_path / "catalogue.pkl", pickle.dumps((catalogue, ref)))
    assert data.stat().st_size < 5000
    code = (
        "import pickle, sys; from workers.assets.catalogue import load_asset; "
        "print(load_asset(*pickle.load(open(sys.argv[1], 'rb'))).sha256)"
    )
    command = [sys.executable, "-c", code, str(data)]
    out = subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert out.stdout.strip() == load_asset(catalogue, ref).sha256


def test_instances_fall_into_splits_by_their_shares_and_stay_there():
    shares = SplitShares(train=0.7, val=0.2, test=0.1)
    splits = [shares.of(f"mug-0-{k:06d}") for k in range(20_000)]
    # Standard deviations of the three counts: 65, 57 and 42.
    for name, expected in (("train", 14_000), ("val", 4000), ("test", 2000)):
        assert splits.count(name) == pytest.approx(expected, abs=330)
    assert splits[123] == shares.of("mug-0-000123")
    assert {SplitShares(train=0, val=0, test=1).of(f"{k}") for k in range(100)} == {"test"}


def make(name):
    return asset_of(trimesh.creation.icosphere(2), category=name)


def test_the_oldest_assets_go_when_the_memory_is_full_a_used_one_stays_and_one_is_kept_however_large(
    tmp_path, monkeypatch
):
    catalogue = opened(tmp_path, BUILT_IN.model_copy(update={"instances": 9}))
    loads, cache = [], open_cache(2 * asset_bytes(make("mug")))
    monkeypatch.setattr(catalogue_file, "_cache", cache)

    def refuse(*_):
        raise MeshError("unreadable", "no")

    with monkeypatch.context() as patch:
        patch.setattr(Catalogue, "load", refuse)
        with pytest.raises(MeshError):
            load_asset(catalogue, catalogue.refer(0, "mug", 0))
    monkeypatch.setattr(Catalogue, "load", lambda _, ref: loads.append(ref.index) or make("mug"))
    for index in (0, 1, 0, 2, 0, 1):
        load_asset(catalogue, catalogue.refer(0, "mug", index))
    assert loads == [0, 1, 2, 1] and len(cache) == 2, "what was refused is tried again"
    assert cache.currsize == 2 * asset_bytes(make("mug"))
    small = open_cache(1)
    for name in "ab":
        small[name] = make(name)
        assert list(small) == [name]


def test_shapes_of_which_hardly_one_comes_again_are_not_kept(tmp_path):
    for instances, kept in ((1_000_000, False), (100, True)):
        catalogue = opened(tmp_path, BUILT_IN.model_copy(update={"instances": instances}))
        ref = choose_object(catalogue, "mug", np.random.default_rng(1))
        first, second = load_asset(catalogue, ref), load_asset(catalogue, ref)
        assert (first is second) == kept and first.sha256 == second.sha256

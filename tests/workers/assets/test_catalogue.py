"""The catalogue: what it lists, chooses and loads, and the cache of assets that keeps within its memory."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import (
    CATEGORIES,
    Assets,
    FolderSource,
    MeshLimits,
    ProceduralSource,
    ShapeNetSource,
    SplitShares,
)
from tests.kit.shapes import asset_of
from tests.workers.assets.oracles import CUBE, write
from workers.assets import catalogue as step
from workers.assets.catalogue import (
    Catalogue,
    asset_bytes,
    choose_object,
    choose_table,
    list_source,
    load_asset,
    open_cache,
    open_catalogue,
    split_of,
)
from workers.assets.external.verdicts import Verdicts

BUILT_IN = ProceduralSource(source="procedural")
REPOSITORY = Path(__file__).resolve().parents[3]


def folder(name="things", **more):
    return FolderSource(source="urdf", folder=name, category_map={"mug*.obj": "mug", "table*.obj": "table"}, **more)


def opened(tmp_path, objects=(BUILT_IN,), tables=(BUILT_IN,), categories=("mug",)):
    return open_catalogue(Assets(objects=tuple(objects), tables=tuple(tables)), tmp_path, categories)


def test_the_built_in_source_offers_every_category_and_tables(tmp_path):
    catalogue = opened(tmp_path, categories=CATEGORIES)
    for category in CATEGORIES:
        ref = choose_object(catalogue, category, np.random.default_rng(0))
        asset = load_asset(catalogue, ref)
        assert (asset.category, asset.instance_id) == (category, ref.instance_id)
    assert load_asset(catalogue, choose_table(catalogue, np.random.default_rng(0))).category == "table"


def test_built_in_shapes_need_no_listing_and_have_every_category(tmp_path):
    assert list_source(BUILT_IN, tmp_path / "nowhere", ("mug",), MeshLimits()) is None
    few = BUILT_IN.model_copy(update={"seed": 4, "instances": 7})
    catalogue = opened(tmp_path, objects=(few,), tables=(few,))
    assert catalogue.offers("mug") == catalogue.offers("table") == [(0, few, 7)]
    ref = catalogue.refer(0, "mug", 3)
    assert catalogue.load(ref).instance_id == ref.instance_id == "mug-4-000003"


def test_a_folder_has_what_its_listing_says_and_loads_it_unless_it_has_changed(tmp_path):
    path, settings = write(tmp_path / "things" / "mug.obj", CUBE), folder()
    catalogue = opened(tmp_path, objects=(settings,))
    assert [catalogue.offers(category) for category in ("mug", "can")] == [[(0, settings, 1)], []]
    ref = catalogue.refer(0, "mug", 0)
    assert catalogue.load(ref).instance_id == ref.instance_id
    write(path, CUBE + "#")
    with pytest.raises(MeshError, match="changed"):
        catalogue.load(ref)


def test_the_same_draw_gives_the_same_instance_and_one_stream_uses_two_numbers(tmp_path):
    catalogue = opened(tmp_path)
    one, two = np.random.default_rng(5), np.random.default_rng(5)
    assert choose_object(catalogue, "mug", one) == choose_object(catalogue, "mug", two)
    assert one.random() == two.random()


def test_sources_are_mixed_by_weight_and_instances_evenly(tmp_path):
    for k in range(3):
        write(tmp_path / "things" / f"mug{k}.obj", CUBE)
    catalogue = opened(tmp_path, objects=(folder(weight=3.0), BUILT_IN.model_copy(update={"weight": 1.0})))
    rng = np.random.default_rng(0)
    refs = [choose_object(catalogue, "mug", rng) for _ in range(4000)]
    from_folder = [ref.index for ref in refs if ref.source == 0]
    # A binomial of 4000 draws at 3/4 has a standard deviation of 27.
    assert len(from_folder) == pytest.approx(3000, abs=5 * 27)
    assert np.bincount(from_folder) == pytest.approx(np.full(3, 1000), abs=5 * 27)


def test_a_source_without_the_category_is_never_chosen(tmp_path):
    write(tmp_path / "things" / "mug.obj", CUBE)
    catalogue = opened(tmp_path, objects=(folder(weight=1000.0), BUILT_IN), categories=("mug", "can"))
    rng = np.random.default_rng(0)
    assert {choose_object(catalogue, "can", rng).source for _ in range(50)} == {1}


def test_a_category_that_nobody_offers_is_refused_with_what_was_found_and_a_remedy(tmp_path):
    write(tmp_path / "things" / "mug.obj", CUBE)
    with pytest.raises(
        AssetSourceError, match=r"no source in assets.objects offers 'can'.*has 1 mug.*source: procedural"
    ):
        opened(tmp_path, objects=(folder(),), categories=("mug", "can"))
    with pytest.raises(AssetSourceError, match=r"no source in assets.tables offers 'table'.*folder that has tables"):
        opened(tmp_path, tables=(folder(),))


def test_box_from_shapenet_alone_is_refused_with_the_reason(tmp_path):
    write(tmp_path / "net" / "03797390" / "a" / "model.obj", CUBE)
    source = ShapeNetSource(source="shapenet", folder="net")
    with pytest.raises(AssetSourceError, match="ShapeNetCore has no box"):
        opened(tmp_path, objects=(source,), categories=("mug", "box"))
    assert opened(tmp_path, objects=(source, BUILT_IN), categories=("mug", "box"))


def test_a_missing_folder_is_refused_when_the_catalogue_opens(tmp_path):
    with pytest.raises(AssetSourceError, match="nowhere is not a folder"):
        opened(tmp_path, objects=(folder("nowhere"),))


def test_a_folder_whose_meshes_are_all_broken_is_refused_when_the_catalogue_opens(tmp_path):
    for k in range(4):
        write(tmp_path / "things" / f"mug{k}.obj", "v 0 0 0\n")
    with pytest.raises(AssetSourceError, match=r"none of 4 meshes for 'mug' in .*mug0.obj \(no_faces: "):
        opened(tmp_path, objects=(folder(),))


def test_a_bad_mesh_among_good_ones_is_known_at_once_and_never_drawn_and_moves_no_other_draw(tmp_path):
    for k in range(4):
        write(tmp_path / "things" / f"mug{k}.obj", CUBE + "#" * k)
    before = opened(tmp_path, objects=(folder(),))
    write(tmp_path / "things" / "mug2.obj", "v 0 0 0\n")
    after = opened(tmp_path, objects=(folder(),))
    assert (before.skipped, after.skipped) == ({}, {str(tmp_path / "things"): {"no_faces": 1}})
    assert [catalogue.offers("mug")[0][2] for catalogue in (before, after)] == [4, 3]
    assert before.digest != after.digest
    draws = []
    for seed in range(200):
        one, two = (choose_object(catalogue, "mug", np.random.default_rng(seed)) for catalogue in (before, after))
        assert two == one or one.index == 2
        draws.append(two.index)
    # A binomial of 200 draws at 1/3 has a standard deviation of 6.7.
    counts = np.bincount(draws, minlength=4)
    assert counts[2] == 0 and counts[[0, 1, 3]] == pytest.approx(np.full(3, 200 / 3), abs=5 * 6.7)
    assert load_asset(after, after.refer(0, "mug", 1)).watertight
    with pytest.raises(MeshError, match="no_faces"):
        load_asset(after, after.refer(0, "mug", 2))


def test_how_far_the_opening_is_is_told(tmp_path):
    for k in range(3):
        write(tmp_path / "things" / f"mug{k}.obj", CUBE + "#" * k)
    told = []
    assets = Assets(objects=(folder(),))
    open_catalogue(assets, tmp_path, ("mug",), lambda *step: told.append(step), Verdicts(None))
    assert told == [("listed", 3, 3), ("checked", 3, 3)]


def test_what_was_left_out_is_counted_by_reason(tmp_path):
    write(tmp_path / "things" / "mug0.obj", CUBE)
    write(tmp_path / "things" / "mug1.obj", CUBE * 100)
    assets = Assets(objects=(folder(),), limits=Assets().limits.model_copy(update={"max_faces": 50}))
    catalogue = open_catalogue(assets, tmp_path, ("mug",))
    assert catalogue.skipped == {str(tmp_path / "things"): {"too_large": 1}}


def test_the_digest_knows_every_byte_setting_and_category_but_not_where_the_folder_lies(tmp_path):
    def digest(name="things", text=CUBE, skin=b"png", **more):
        write(tmp_path / name / "mug.obj", "mtllib mug.mtl\n" + text)
        write(tmp_path / name / "mug.mtl", "newmtl a\nmap_Kd skin.png\n")
        write(tmp_path / name / "skin.png", skin)
        return opened(tmp_path, objects=(folder(name, **more),)).digest

    same = digest()
    assert digest() == same
    assert digest("elsewhere") == same
    others = [digest(text=CUBE + "#"), digest(skin=b"pnG"), digest(scale=2.0), digest(weight=2.0)]
    others += [opened(tmp_path).digest, opened(tmp_path, categories=("mug", "can")).digest]
    others += [
        opened(tmp_path, objects=(BUILT_IN.model_copy(update=change),)).digest
        for change in ({"seed": 1}, {"instances": 7})
    ]
    assert len({same, *others}) == 1 + len(others)


def test_one_seed_with_two_sizes_is_refused(tmp_path):
    metric = BUILT_IN.model_copy(update={"size": "metric"})
    with pytest.raises(AssetSourceError, match="the seed 0 and different sizes"):
        opened(tmp_path, objects=(BUILT_IN, metric))
    assert opened(tmp_path, objects=(BUILT_IN, metric.model_copy(update={"seed": 1})))


def test_an_opened_catalogue_travels_small_and_loads_the_same_asset_in_another_process(tmp_path):
    catalogue = opened(tmp_path)
    ref = choose_object(catalogue, "mug", np.random.default_rng(3))
    data = pickle.dumps((catalogue, ref))
    assert len(data) < 5000
    write(tmp_path / "catalogue.pkl", data)
    code = (
        "import pickle, sys; from workers.assets.catalogue import load_asset; "
        "print(load_asset(*pickle.load(open(sys.argv[1], 'rb'))).sha256)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "catalogue.pkl")]
    out = subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert out.stdout.strip() == load_asset(catalogue, ref).sha256


def test_a_file_that_changes_after_opening_is_refused(tmp_path):
    path = write(tmp_path / "things" / "mug0.obj", CUBE)
    write(tmp_path / "things" / "mug1.obj", CUBE)
    catalogue = opened(tmp_path, objects=(folder(),))
    rng = np.random.default_rng(0)
    ref = next(r for r in (choose_object(catalogue, "mug", rng) for _ in range(50)) if r.index == 1)
    write(path.with_name("mug1.obj"), CUBE + "#")
    with pytest.raises(MeshError, match="changed"):
        load_asset(catalogue, ref)


def test_instances_fall_into_splits_by_their_shares_and_stay_there():
    shares = SplitShares(train=0.7, val=0.2, test=0.1)
    ids = [f"mug-0-{k:06d}" for k in range(20_000)]
    splits = [split_of(name, shares) for name in ids]
    # Standard deviations of the three counts: 65, 57 and 42.
    for name, expected in (("train", 14_000), ("val", 4000), ("test", 2000)):
        assert splits.count(name) == pytest.approx(expected, abs=330)
    assert split_of("mug-0-000123", shares) == split_of("mug-0-000123", shares)
    assert {split_of(name, SplitShares(train=0, val=0, test=1)) for name in ids[:100]} == {"test"}


def make(name):
    return asset_of(trimesh.creation.icosphere(2), category=name)


def opened_procedural(tmp_path, instances=9):
    source = ProceduralSource(source="procedural", instances=instances)
    return open_catalogue(Assets(objects=(source,), tables=(source,)), tmp_path, ("mug",))


@pytest.fixture
def loads(monkeypatch):
    """The index of every instance that is loaded and not found in an empty cache for two assets."""
    made = []
    monkeypatch.setattr(Catalogue, "load", lambda _, ref: made.append(ref.index) or make("mug"))
    monkeypatch.setattr(step, "_cache", open_cache(2 * asset_bytes(make("mug"))))
    return made


def test_the_oldest_assets_go_when_the_memory_is_full_and_a_used_one_stays(tmp_path, loads):
    catalogue = opened_procedural(tmp_path)
    for index in (0, 1, 0, 2, 0, 1):
        load_asset(catalogue, catalogue.refer(0, "mug", index))
    assert loads == [0, 1, 2, 1]
    assert len(step._cache) == 2
    assert step._cache.currsize == 2 * asset_bytes(make("mug"))


def test_one_asset_is_kept_however_large():
    cache = open_cache(1)
    first, second = make("a"), make("b")
    cache["a"] = first
    assert cache["a"] is first
    cache["b"] = second
    assert list(cache) == ["b"]


def test_a_mesh_that_was_refused_is_tried_again(tmp_path, loads, monkeypatch):
    def refuse(*args):
        raise MeshError("unreadable", "no")

    catalogue = opened_procedural(tmp_path)
    monkeypatch.setattr(Catalogue, "load", refuse)
    for _ in range(2):
        with pytest.raises(MeshError):
            load_asset(catalogue, catalogue.refer(0, "mug", 0))
    assert len(step._cache) == 0


@pytest.mark.parametrize(("instances", "kept"), [(1_000_000, False), (100, True)])
def test_shapes_of_which_hardly_one_comes_again_are_not_kept(tmp_path, instances, kept):
    catalogue = opened_procedural(tmp_path, instances)
    ref = choose_object(catalogue, "mug", np.random.default_rng(1))
    first, second = load_asset(catalogue, ref), load_asset(catalogue, ref)
    assert (first is second) == kept
    assert first.sha256 == second.sha256

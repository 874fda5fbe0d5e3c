"""Categories, copies, units and the axis that is up, guessed for a folder of meshes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.job.assets import is_usable
from schemas.scene.shape import Material, Mesh, Part, Shape
from workers.assets.library.collection import SUFFIXES
from workers.assets.library.copies import Item, find_copies, find_doubles
from workers.assets.library.guess import find_joined, guess_groups, guess_ups, name_categories
from workers.assets.library.placement import Measured, measure_handed, sample_look
from workers.door.meshes.raw import DEFAULT

CATEGORIES = (
    (None, {"mug/a.obj": "mug"}),
    (None, {"mug/a.obj": "mug", "mug/b/c.obj": "mug", "can/d.obj": "can"}),
    (None, {"002_master_chef_can/google_16k/textured.obj": "002_master_chef_can"}),
    (None, {"mug_03.obj": "mug", "mug 4.obj": "mug", "007.obj": "n007", "Blue Cup-12.glb": "Blue-Cup"}),
    ("folder", {"mug 3.obj": "mug", "all/can/a.obj": "all", "12/b.obj": "n12"}),
    ("folder", {"all/can/a.obj": "can", "all/mug/blue/b.obj": "mug"}),
    ("parent", {"all/can/a.obj": "can", "all/mug/blue/b.obj": "blue", "c_1.obj": "c"}),
    ("file", {"mug/a_7.obj": "a"}),
    ("thing", {"mug/a_7.obj": "thing", "b.obj": "thing"}),
    (None, {"table/a.obj": "table_mesh", "Manifest/a.obj": "Manifest_mesh"}),
    (
        None,
        {"杯子/a.obj": "杯子", "чашка/b.obj": "чашка", "näme/a.obj": "näme", "a\u0308/b.obj": "ä", "मग/c.obj": "मग"},
    ),
    (None, {f"{'long' * 40}/a.obj": "long" * 16, f"{'杯' * 99}/a.obj": "杯" * 64, "\u0301!/a.obj": "object"}),
    # A repository: what all share says nothing, nor do identifiers and what says `mesh`; numbers that tell several apart go.
    (None, {"p/ycb/Banana/model.urdf": "Banana", "p/ycb/Mug/model.urdf": "Mug", "p/rand/000/000.urdf": "rand"}),
    (None, {"x/mug/a1b2c3d4/model.obj": "mug", "x/mug/b1b2c3d4/model.obj": "mug", "x/can/c1b2c3d4/model.obj": "can"}),
    (None, {"mug/1a2b3c4d/model.obj": "mug", "mug/9a2b3c4d/model.obj": "mug"}),
    (None, {"mug_01/model.obj": "mug", "mug_02/model.obj": "mug", "can_1/model.obj": "can_1"}),
    (None, {"Shoe_A/meshes/model.obj": "Shoe_A", "Shoe_B/meshes/model.obj": "Shoe_B"}),
    (None, {"food/OBJ format/pear.obj": "food", "food/OBJ format/fig.obj": "food", "car/OBJ format/van.obj": "car"}),
    (None, {"kit/Models/GLB format/fig.glb": "fig", "kit/Models/GLB format/pear.glb": "pear"}),
    (None, {"chair/train/chair_1.off": "chair", "chair/test/chair_2.off": "chair", "bed/train/bed_1.off": "bed"}),
    (
        None,
        {"k/mugs/a.obj": "mugs", "k/mugs/b.obj": "mugs", "k/jars/c.obj": "jars", "k/jars/d.obj": "jars", "e.obj": "e"},
    ),
)


def test_categories_follow_from_where_files_lie_and_what_they_and_their_folders_are_called():
    for source, categories in CATEGORIES:
        assert name_categories(categories, source) == categories
        assert all(is_usable(name) for name in categories.values())


def test_different_names_that_become_one_are_told():
    paths = ["a: b/x.obj", "a: b/y.obj", "a #b/x.obj", "a #b/y.obj", "c/x.obj", "c/y.obj"]
    assert set(name_categories(paths, None).values()) == {"a-b", "c"}
    assert find_joined(paths, None) == {"a-b": "category a-b is of 'a #b', 'a: b'"}


def item(path, extents=(0.1, 0.1, 0.1), up=None, confidence="sure", **more):
    return Item(path, Measured(extents, 12, True, 0, (), up, confidence if up else None, **more), path)


def cubes(*diagonals, suffix=".obj", folder=""):
    return [item(f"{folder}{k}{suffix}", (d / 3**0.5,) * 3) for k, d in enumerate(diagonals)]


UNITS = (
    (cubes(0.2, 0.3), {1.0: 2}, "metres"),
    (cubes(250.0), {0.001: 1}, "millimetres, 25 cm"),
    (cubes(25.0), {0.01: 1}, "centimetres, 25 cm (as millimetres, 0.001, it would be 2.5 cm)"),
    (cubes(1.0, 0.4, 0.7), {1.0: 3}, "metres"),
    (cubes(0.0001), {1.0: 1}, "metres, 0.1 mm"),
    (cubes(3000.0, 150.0, 200.0), {0.001: 3}, "millimetres"),
    (cubes(1.0), {1.0: 1}, "metres"),
    (cubes(0.12, 0.12, 0.12), {1.0: 3}, "metres"),  # three cups of one size
    # Specifications say metres, and are believed unless that is impossible; the other reading stands beside.
    (
        cubes(2.72, suffix=".glb"),
        {1.0: 1},
        "metres, as the format says, 2.72 m (as centimetres, 0.01, it would be 2.72 cm)",
    ),
    (cubes(5.0, 3.0, suffix=".dae"), {1.0: 2}, "metres, as the format says"),
    (cubes(5.0, 3.0, suffix=".urdf"), {1.0: 2}, "metres, as the format says"),
    (cubes(*[0.004] * 59, suffix=".gltf"), {1.0: 59}, "metres, as the format says, 4 mm"),
    (cubes(150.0, 90.0, suffix=".glb"), {0.001: 2}, "millimetres"),
    # Folders and files of a folder may differ, as sizes tell.
    (
        [*cubes(0.4, 0.3, 0.5, folder="a/"), *cubes(400.0, 300.0, folder="b/")],
        {1.0: 3, 0.001: 2},
        ".obj in b: 350 units",
    ),
    ([*cubes(6.0, 22.0, 15.0, folder="hope/"), *cubes(0.2, 0.1, folder="x/")], {0.01: 3, 1.0: 2}, "centimetres, 15 cm"),
    (cubes(0.2, 0.3, 250.0), {1.0: 2, 0.001: 1}, "metres"),
    (
        cubes(0.06, 0.1, 0.15, 0.05, 58.8, 83.7, 40.6),
        {1.0: 4, 0.001: 3},
        "millimetres",
    ),  # 58.8 alone might be centimetres
    (cubes(1.0, 1.6, 0.9, 4.4, 5.2, 2.6, 2.2, 389.0, 638.0), {1.0: 7, 0.001: 2}, "millimetres, 51.3 cm"),
    (
        cubes(20.0, 15.0, 30.0, 12.0, 25.0, 0.25, 2500.0),
        {0.01: 5, 1.0: 1, 0.001: 1},
        "metres, 25 cm",
    ),  # apart, each its own
    (cubes(250.0, 90.0, 4.0), {0.001: 3}, "millimetres"),  # a screw among millimetres is small
    # A remark in the file.
    ([item("a.obj", (8.0, 8.0, 12.0), unit_m=0.0254)], {0.0254: 1}, "inches, as the files say"),
)


def test_the_unit_is_what_a_file_says_or_what_things_on_a_table_have_by_folder():
    for items, factors, words in UNITS:
        groups = guess_groups(items)
        assert {group.factor: len(group.paths) for group in groups} == factors, items
        assert any(words in why for group in groups for why in group.why)
    for suffix, diagonal_m in ((".obj", 0.25), (".glb", None)):  # what is normalised is resized; glTF is in metres
        (group,) = guess_groups(cubes(1.0, 1.0, 1.001, suffix=suffix))
        assert (group.factor, group.diagonal_m) == (1.0, diagonal_m)
    groups = guess_groups([*cubes(250.0), *cubes(0.2, suffix=".glb"), *cubes(300.0, suffix=".stl")])
    assert {group.paths: group.factor for group in groups} == {("0.glb",): 1.0, ("0.obj", "0.stl"): 0.001}


def test_a_format_without_units_has_those_and_the_axis_of_the_same_things_in_one_that_says_metres():
    """As packs of assets have them: a folder for each format, large things, and some that only one of them has."""
    sizes = {"wall": (4.0, 4.0, 0.5), "fridge": (2.0, 2.5, 1.5), "chair": (0.8, 1.2, 0.7)}
    metric = [item(f"pack/GLTF format/{name}.gltf", size) for name, size in sizes.items()]
    for unit, order in ((1.0, (0, 1, 2)), (100.0, (0, 2, 1)), (1000.0, (0, 1, 2))):
        turned = {name: tuple(unit * size[k] for k in order) for name, size in sizes.items()}
        same = [item(f"pack/obj/{name}.obj", size) for name, size in turned.items()]
        alone = item("pack/obj/fridge_door.obj", tuple(unit * extent for extent in (2.0, 1.5, 0.7)))
        of = {path: group.factor for group in guess_groups([*metric, alone], same) for path in group.paths}
        assert of == {**{each.path: 1.0 for each in metric}, alone.path: 1.0 / unit}
        assert guess_ups([*metric, alone], same)[alone.path][0] == ("y" if order == (0, 1, 2) else "z")
    other = item("others/obj/fridge_door.obj", (2000.0, 1500.0, 700.0))
    (group,) = (group for group in guess_groups([*metric, other], same) if other.path in group.paths)
    assert group.factor == 0.001


def test_up_follows_the_files_that_are_sure_and_a_specification_unless_most_of_all_files_speak_against_it():
    def ups(*items):
        return {path: axis for path, (axis, _) in guess_ups(items).items()}

    sure = [item(f"{k}.obj", up="y") for k in range(5)]
    assert ups(*sure, item("box.obj"), item("odd.obj", up="z")) == {
        **dict.fromkeys([f"{k}.obj" for k in range(5)], "y"),
        "box.obj": "y",
        "odd.obj": "z",
    }
    for suffix in (".obj", ".glb"):
        z, y = (
            [item(f"{name}/{k}{suffix}", up=up) for k in range(n)] for name, up, n in (("a", "z", 9), ("b", "y", 3))
        )
        fits = ups(*z, *y, item(f"b/box{suffix}"), item(f"box{suffix}"))
        assert (fits[f"a/0{suffix}"], fits[f"b/box{suffix}"], fits[f"box{suffix}"]) == ("z", "y", "z"), "by folder"
    assert ups(item("box.glb"), item("a.gltf", up="z", confidence="likely")) == {"box.glb": "y", "a.gltf": "y"}
    assert ups(item("mug.glb", up="z")) == {"mug.glb": "z"}, "most of all files are sure"
    for suffix, axis in ((".glb", "y"), (".urdf", "z"), (".xml", "z")):
        fits = guess_ups([item(f"{k}{suffix}", up="x" if k > 2 else None) for k in range(6)])
        assert fits[f"0{suffix}"][0] == axis and "3 of 6 stand on another axis alone" in fits[f"0{suffix}"][1], (
            "half are not most"
        )
        mixed = guess_ups([item(f"{k}{suffix}", up="xyz"[k % 3]) for k in range(6)])
        assert "though 4 of 6 stand on another axis alone" in mixed[f"{'xyz'.index(axis)}{suffix}"][1]
        assert fits[f"5{suffix}"][0] == ("y" if suffix == ".glb" else "x"), "but a robot's file may lie on its side"
    for suffix, axis in ((".sdf", "z"), (".stl", "x")):
        fits = ups(*(item(f"{k}{suffix}") for k in range(5)), item(f"5{suffix}", up="x", rests_on_z=True))
        assert fits[f"5{suffix}"] == axis, "one that rests as its file has it is left so, where z is up by use"
    stated = [item(f"{k}.dae", stated_up="y") for k in range(3)]
    assert ups(*stated, item("z.dae", stated_up="z"))["z.dae"] == "z", "as each file says"
    assert ups(*stated, item("s.dae", up="x", stated_up="y"))["s.dae"] == "y", "one file alone may be mistaken"
    assert ups(item("a.obj", up="y"), item("b.obj", up="x"), item("c.obj")) == {
        "a.obj": "y",
        "b.obj": "x",
        "c.obj": "z",
    }
    for confidence, axis, why in (("likely", "y", "likely: 1 of 2"), (None, "z", "not known")):
        fits = guess_ups([item("a.obj", up=confidence and "y", confidence=confidence), item("b.obj")])
        assert fits["b.obj"][0] == axis and fits["b.obj"][1].startswith(why)


COPIES = {
    "model.obj": (
        "model_collision_0.obj",
        "model_collision_31.obj",
        "model_vhacd.obj",
        "model_coacd.obj",
        "model_col.obj",
    ),
    "soup/textured.obj": ("soup/alphabet_soup_coll.obj", "soup/collision/textured_ch.stl"),
    "bowl/model.obj": ("bowl/ceramic_col.obj",),
    "butter/butter.obj": ("butter/hope_butter_coll.obj",),
    "bowl/red_bowl.xml": (),
    "butter/food.xml": (),
    "ur5/visual/base.dae": ("ur5/collision/base.obj",),
    "car_LOD0.glb": ("car_LOD1.glb", "car_LOD2.glb"),
    "tea/model.urdf": ("tea/collision.obj", "tea/Collision_Mesh.stl"),
    "jar.obj": ("jar_lod1.obj", "UCX_jar_01.obj"),
    "lamp_lod2.obj": ("lamp_lod3.obj",),
    "bun_zipper.ply": ("bun_zipper_res2.ply",),
    "bun_zipper_res2.ply": ("bun_zipper_res4.ply",),
}
ORIGINALS = (
    "duck_vhacd.urdf",
    "column.obj",
    "school.obj",
    "alone_collision.obj",
    "x/coll/mug.obj",
    "free_hull.obj",
    "mocha-col1.obj",
    "hull.obj",
    "boxes/collision.obj",
)


def test_collision_shapes_and_coarser_levels_are_left_out_with_what_they_belong_to():
    everything = [*COPIES, *(path for paths in COPIES.values() for path in paths)]
    found = find_copies(everything, everything)
    assert {path: why.rpartition(" of ")[2] for path, why in found.items()} == {
        path: of for of, paths in COPIES.items() for path in paths
    }
    for path in ORIGINALS:
        assert find_copies([path], [path, "duck.obj", "other.obj", "more.obj"]) == {}, (
            f"{path} is all that there is of it"
        )


def solid(path, size=1.0, turned=False, faces=200, look=None, volume=0.3, **more):
    extents = (0.1 * size, 0.3 * size, 0.2 * size) if turned else (0.1 * size, 0.2 * size, 0.3 * size)
    measured = Measured(extents, faces, True, 0, (), area=0.2 * size**2, volume=volume * size**3, look=look)
    return Item(path, replace(measured, **more), path)


def ball(front=0.05, back=0.05, tint=1.0, axes=(0, 1, 2), cell=7):
    """A look: of a ball whose sides of x use two places of one palette, each an eighth of it; or a picture of a pattern."""
    palette = np.repeat(np.random.default_rng(cell).integers(0, 256, (1, 8, 3), dtype=np.uint8), 64, axis=1)
    mesh = trimesh.creation.uv_sphere(0.1, count=[24, 24])
    faces = mesh.faces[np.argsort(mesh.triangles_center[:, 0])]
    u = np.where(mesh.vertices[:, 0] > 0.0, front, back)
    vertices, material = mesh.vertices[:, axes], Material((tint, tint, tint, 1.0), texture=palette)
    part = Part("", vertices, faces.astype(np.int32), material, uv=np.stack([u, np.full(len(u), 0.5)], axis=1))
    return sample_look(Shape((part,)))


RED, RED_TURNED, BLUE = ball(0.06, 0.06), ball(0.065, 0.06, axes=(1, 2, 0)), ball(0.19, 0.19)


def test_looks_differ_by_the_colours_where_faces_lie_and_not_by_how_the_thing_is_turned():
    def like(one, other):
        pair = [solid(f"{k}.obj", look=look, textures=1) for k, look in enumerate((one, other))]
        return len(find_doubles(pair, lambda item: item.diagonal, SUFFIXES)) == 1

    two = ball(0.06, 0.19)
    for axes in ((1, 2, 0), (0, 2, 1)):
        assert like(two, ball(0.06, 0.19, axes=axes)) and like(two, ball(0.19, 0.06, axes=axes)), "turned by half"
    assert not like(two, RED) and not like(RED, BLUE) and not like(RED, ball(0.06, 0.06, tint=0.5))
    assert sample_look(Shape((Part("", np.eye(3), np.array([[0, 1, 2]], np.int32), DEFAULT),))) is None
    patterned = [sample_look(patterned_box(seed)) for seed in (1, 1, 2)]
    means = [np.reshape(look, (-1, 3)).sum(axis=0) for look in patterned]
    assert np.allclose(means[0], means[2], atol=1.0), "as bright in the mean"
    assert like(*patterned[:2]) and not like(*patterned[1:])


def test_a_mirror_image_has_the_other_sign_however_it_is_turned_and_what_is_its_own_has_none():
    def handed(mesh):
        return measure_handed(Mesh(mesh.vertices, mesh.faces))

    def with_arms(*arms):
        boxes = [trimesh.creation.box(bounds=bounds) for bounds in arms]
        return trimesh.util.concatenate([box.subdivide().subdivide() for box in boxes])

    left = with_arms([[0, 0, 0], [3, 1, 1]], [[0, 1, 0], [1, 2.5, 1]], [[2, 0, 1], [3, 1, 1.7]])
    rotations = [
        np.eye(4),
        *(trimesh.transformations.random_rotation_matrix(x) for x in np.random.default_rng(0).random((8, 3))),
    ]
    for T in rotations:
        assert (
            handed(left.copy().apply_transform(T)) == pytest.approx(handed(left), rel=1e-6) and abs(handed(left)) > 0.01
        )
        assert handed(left.copy().apply_transform(T @ np.diag([1, -1, 1, 1]))) == pytest.approx(-handed(left), rel=1e-6)
        assert abs(handed(with_arms([[0, 0, -1], [3, 1, 1]], [[2, 1, -1], [3, 3, 1]]).apply_transform(T))) < 1e-6
    flat, faces = np.random.default_rng(1).normal(size=(27, 3)) * (1.0, 1.0, 0.0), np.arange(27).reshape(9, 3)
    assert measure_handed(Mesh(flat, faces)) == measure_handed(Mesh(0 * flat, faces)) == 0.0


def patterned_box(seed):
    """A cube with one picture on each side: as many black as white squares, in an order of its own."""
    squares = np.random.default_rng(seed).permutation(np.repeat(np.array([0, 255], np.uint8), 18)).reshape(6, 6)
    picture = np.repeat(np.repeat(squares, 16, axis=0), 16, axis=1)[:, :, None].repeat(3, axis=2)
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    corners = mesh.triangles.reshape(-1, 3)
    normals = np.repeat(mesh.face_normals, 3, axis=0)
    uv = np.array(
        [np.delete(corner, np.abs(n).argmax()) / 0.1 + 0.5 for corner, n in zip(corners, normals, strict=True)]
    )
    faces = np.arange(36, dtype=np.int32).reshape(-1, 3)
    return Shape((Part("", corners, faces, Material((1.0, 1.0, 1.0, 1.0), texture=picture), uv=uv),))


def test_one_object_twice_is_offered_once_and_like_shapes_are_not_one():
    doubles = (
        (solid("a/model.urdf", textures=1), solid("a/visual.ply", 1000.0)),  # in another unit
        (solid("a.urdf"), solid("b/c.ply", turned=True)),
        (solid("a/m.glb", faces=12), solid("a/m.obj", faces=12)),
        (solid("a/textured.obj", textures=1, faces=12), solid("a/nontextured.ply", faces=12)),
        (solid("bread.xml"), solid("meshes/bread.obj", 1.25)),  # which the model scales
        (solid("pack/GLTF format/m.glb", faces=12), solid("pack/obj/m.obj", 100.0, faces=12)),
        (solid("pack/GLTF format/m.glb", look=RED), solid("pack/DAE format/m.dae", look=BLUE)),
        (solid("pack/GLTF format/m.glb", faces=116), solid("pack/DAE format/m.dae", faces=115)),  # without an empty one
        (solid("x/a.urdf", faces=12), solid("x/visual/b.obj", faces=12)),
        (solid("a.obj", look=RED, textures=1), solid("b/a.obj", look=RED_TURNED, textures=1)),
        (solid("a.obj", look=RED, textures=1), solid("b/a.obj", look=BLUE)),
        (solid("a/glove.obj", handed=0.1), solid("b/glove.obj", handed=0.1)),
        (solid("a/glove.obj", handed=0.0004), solid("b/glove.obj", handed=-0.0004)),  # what rounding leaves of 0
        (solid("a/glove.glb", handed=0.1), solid("a/glove.obj", handed=-0.1)),  # some programs write x to the left
    )
    for first, second in doubles:
        for pair in ((first, second), (second, first)):
            (one,) = find_doubles(pair, lambda item: item.diagonal, SUFFIXES)
            assert (one.path, one.why) == (second.path, f"double of {first.path}")
    for first, second in (
        (solid("a/m.obj"), solid("a/n.obj", 1.1)),  # of another size
        (solid("a/m.obj"), solid("b/m.stl", 1000.0)),
        (solid("a/glb/m.glb", faces=12), solid("b/obj/m.obj", faces=12)),
        (solid("a/glb/m.glb", look=RED), solid("a/obj/n.obj", look=BLUE)),
        (solid("a.obj"), solid("b.obj", volume=0.31)),
        (solid("a.obj"), solid("b.obj", faces=201)),
        (solid("a/box.obj", faces=12), solid("b/box.obj", faces=12)),
        (solid("left/glove.obj", handed=0.1), solid("right/glove.obj", handed=-0.1)),
        (solid("left.glb", handed=-0.033), solid("right.obj", handed=0.033)),
        (solid("a.obj", look=RED, textures=1), solid("b.obj", look=BLUE, textures=1)),
    ):
        assert find_doubles([first, second], lambda item: item.diagonal, SUFFIXES) == []
    assert len(find_doubles([item("a.obj"), replace(item("b.obj"), digest="a.obj")], lambda one: 1.0, SUFFIXES)) == 1

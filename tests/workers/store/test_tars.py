"""Labels beside the images: what they hold is what the tables say, to the last bit of every double."""

import io
import json
import tarfile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.layout import IMAGES, file_pose_id, image_path, patch_path, tar_path
from schemas.errors import CorruptError
from tests.made_up_scenes import attempt_at, made_scene, scene, terms
from tests.stored_images import read_images
from workers.store.local import LocalStore
from workers.store.manifest import decode_table, encode_table, sorted_rows, table_of_rows
from workers.store.tars import (
    LABEL_TABLES,
    check_labels,
    decode_label,
    encode_label,
    label_differences,
    member_of,
    path_of,
    pose_labels,
    read_tar,
)


def tables_of(scene_id):
    return {table: table_of_rows(table, made_scene(scene_id).rows[table]) for table in LABEL_TABLES}


def as_rows(tables):
    return {table: rows.to_pylist() for table, rows in tables.items()}


def test_there_is_a_label_for_each_pose_with_the_views_that_share_its_number():
    labels = pose_labels(as_rows(tables_of(7)))
    category = made_scene(7).rows["scenes"][0]["category"]
    assert {key: sorted(label["views"]) for key, label in labels.items()} == {
        (category, 14): ["aligned", "input", "projected"],
        (category, 15): ["mirror"],
    }


def test_a_label_repeats_the_rows_of_its_views_and_objects():
    rows = as_rows(tables_of(7))
    for label in pose_labels(rows).values():
        for role, view in label["views"].items():
            (row,) = (row for row in rows["views"] if row["role"] == role)
            own = [one for one in rows["objects"] if one["role"] == role]
            assert row.keys() - view.keys() == {"files", "scene_id", "category"}
            assert all(row[name] == value for name, value in view.items() if name != "objects")
            assert [one["region_id"] for one in view["objects"]] == sorted(one["region_id"] for one in own)
            assert view["objects"][0].items() <= own[0].items()
        assert label["scene"].items() >= {"T_world_obj": rows["scenes"][0]["T_world_obj"]}.items()
        assert label["assets"].keys() == {row["instance_id"] for row in rows["assets"]}


def test_a_label_made_from_the_stored_tables_has_the_same_bytes():
    tables = tables_of(7)
    read = {
        table: decode_table(table, encode_table(sorted_rows(table, rows)), "here").to_pylist()
        for table, rows in tables.items()
    }
    first = {key: encode_label(label) for key, label in pose_labels(as_rows(tables)).items()}
    assert {key: encode_label(label) for key, label in pose_labels(read).items()} == first


def test_a_whole_double_is_written_as_a_double_whatever_the_scene_gave():
    output = made_scene(7)
    for view in output.rows["views"]:
        view["fx"] = 525
    rows = {table: table_of_rows(table, output.rows[table]).to_pylist() for table in LABEL_TABLES}
    label = next(iter(pose_labels(rows).values()))
    assert b'"fx":525.0,' in encode_label(label)


def test_a_label_reads_back_as_it_was_and_a_torn_one_is_told():
    label = next(iter(pose_labels(as_rows(tables_of(7))).values()))
    data = encode_label(label)
    assert decode_label(data) == json.loads(json.dumps(label)) == label
    assert list(label_differences(decode_label(data), label)) == []
    for torn in (data[:-5], b"3", b"[" * 100_000, b"\xff"):
        with pytest.raises(ValueError, match=r"Expecting|keys|nested|decode|Unterminated"):
            decode_label(torn)


def test_differences_are_told_by_their_path_and_an_absent_value_is_no_difference():
    stored = {"a": 1, "b": {"c": [1.0, 2.0], "d": None}, "f": -0.0}
    assert list(label_differences(stored, {**stored, "new": None})) == []
    assert list(label_differences(stored, {**stored, "new": 3})) == ["new"]
    assert list(label_differences({**stored, "a": True}, stored)) == ["a"]
    assert list(label_differences({**stored, "f": 0.0}, stored)) == ["f"]
    assert list(label_differences({**stored, "b": {"c": [1.0], "d": None}}, stored)) == ["b.c"]
    assert list(label_differences({**stored, "b": {"c": [1.0, 3.0], "e": 1}}, stored)) == ["b.c.1", "b.e"]


def test_a_view_without_its_scene_has_no_label():
    assert pose_labels(as_rows(tables_of(7)) | {"scenes": []}) == {}


pytestmark = pytest.mark.usefixtures("unflushed")

TAR = terms(layout="tar")


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


@given(
    st.sampled_from(["mug", "can"]),
    st.sampled_from([image.content for image in IMAGES]),
    st.integers(0, 10**8),
    st.none() | st.integers(0, 20),
    st.booleans(),
)
def test_every_image_has_a_member_name_that_leads_back_to_it(category, content, pose_id, index, patch):
    path = patch_path(category, content, pose_id, index) if patch else image_path(category, content, pose_id)
    in_category, member = member_of(path)
    assert in_category == category
    assert path_of(category, member) == path
    assert member.split(".")[:2] == [f"{pose_id:05d}", content]


def test_member_names_are_those_of_the_contract():
    assert member_of("mug/depthAligned00042.png") == ("mug", "00042.depthAligned.png")
    assert member_of("mug/patches/RGB00042obj1.png") == ("mug", "00042.RGB.patch.obj1.png")
    assert tar_path("mug", 16) == "mug/0000000016.tar"
    assert tar_path("mug", 16, retry=2) == "mug/0000000016.retry-2.tar"


@pytest.mark.parametrize(
    "path", ["mug/picture00001.png", "mug/RGB1.png", "mug/RGB00001.jpg", "RGB00001.png", "a/b/RGB00001.png"]
)
def test_a_name_that_is_no_image_has_no_place_in_a_tar(path):
    with pytest.raises(ValueError, match="is not the name of an image"):
        member_of(path)


def test_a_torn_or_foreign_tar_is_told_by_name(store, tmp_path):
    attempt_at(store, 0, 4, TAR).commit()
    data = next(tmp_path.glob("*/*.tar")).read_bytes()
    with pytest.raises(CorruptError, match=r"here.tar is not a whole archive"):
        list(read_tar("mug", data[:700], "here.tar"))
    foreign = io.BytesIO()
    with tarfile.open(fileobj=foreign, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("../../etc/passwd"))
    with pytest.raises(CorruptError, match=r"here.tar is not a whole archive"):
        list(read_tar("mug", foreign.getvalue(), "here.tar"))


def test_there_is_one_tar_for_each_range_and_category_with_every_image_in_it(store, tmp_path):
    record = attempt_at(store, 0, 8, TAR).commit().record
    images = {file.path: file.data for i in range(8) for file in scene(i).files if not file.path.startswith("assets/")}
    assert dict(read_images(store, record)) == images
    tars = {entry.path for entry in record.files if entry.path.endswith(".tar")}
    assert tars == {f"{path.split('/')[0]}/0000000000.tar" for path in images}
    assert not list(tmp_path.glob("*/*.png"))
    assert list(tmp_path.glob("assets/*/*.glb"))


def test_a_tar_is_the_same_whenever_and_by_whomever_it_is_made(store, tmp_path):
    first = attempt_at(store, 0, 4, TAR).commit().record
    other = LocalStore(tmp_path / "other")
    other.prepare()

    def reversed_files(scene_id):
        output = made_scene(scene_id)
        return type(output)(scene_id, output.files[::-1], output.rows)

    second = attempt_at(other, 0, 4, TAR, reversed_files).commit().record
    tars = [[entry for entry in record.files if entry.path.endswith(".tar")] for record in (first, second)]
    assert tars[0] == tars[1]


def test_members_have_no_time_or_owner_and_are_sorted_by_pose(store, tmp_path):
    attempt_at(store, 0, 8, TAR).commit()
    for path in tmp_path.glob("*/*.tar"):
        with tarfile.open(path) as archive:
            members = archive.getmembers()
        assert {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode, m.type) for m in members} == {
            (0, 0, 0, "", "", 0o644, tarfile.REGTYPE)
        }
        poses = [int(m.name.split(".")[0]) for m in members]
        assert poses == sorted(poses)
        first = [m.name for m in members if int(m.name.split(".")[0]) == poses[0]]
        assert first[:4] == [f"{poses[0]:05d}.{n}.png" for n in ("RGB", "RGB.patch", "depth", "depth.patch")]
        assert [name for name in first if name.endswith(".json")] == first[-1:] == [f"{poses[0]:05d}.json"]


def train_samples(path):
    """Samples as WebDataset groups them, with nothing but the standard library: members by what stands before the first point."""
    samples = {}
    with tarfile.open(path) as archive:
        for member in archive:
            key, _, ending = member.name.partition(".")
            samples.setdefault(key, {})[ending] = archive.extractfile(member).read()
    return samples


def test_a_tar_alone_is_enough_to_train_from(store, tmp_path):
    attempt_at(store, 0, 8, TAR).commit()
    found = 0
    for path in tmp_path.glob("*/*.tar"):
        for key, sample in train_samples(path).items():
            label = json.loads(sample["json"])
            scene_id = int(key) // 2
            rows = made_scene(scene_id).rows
            by_role = {
                row["role"]: row for row in rows["views"] if file_pose_id(row["role"], row["parent_id"]) == int(key)
            }
            assert label["pose_id"] == int(key)
            assert label["views"].keys() == by_role.keys()
            view = label["views"]["mirror" if int(key) % 2 else "input"]
            row = by_role["mirror" if int(key) % 2 else "input"]
            assert sample["RGB.png"] and sample["depth.png"]
            assert view["T_world_cam"] == row["T_world_cam"] and view["fx"] == row["fx"]
            assert view["objects"][1]["bbox_xywh"] == [1, 2, 3, 4]
            assert (
                view["objects"][1]["instance_id"] == label["scene"]["instance_id"] == rows["scenes"][0]["instance_id"]
            )
            assert label["scene"]["T_world_obj"] == rows["scenes"][0]["T_world_obj"]
            assert label["split"] == "train"
            found += 1
    assert found == 2 * 7  # scene 5 fails


def forged(path, member, change):
    """An archive with one member changed, or left out where `change` gives None."""
    out = io.BytesIO()
    with tarfile.open(path) as archive, tarfile.open(fileobj=out, mode="w") as other:
        for header in archive:
            data = archive.extractfile(header).read()
            data = change(data) if header.name == member else data
            if data is not None:
                header.size = len(data)
                other.addfile(header, io.BytesIO(data))
    return out.getvalue()


def range_rows_of(scene_ids):
    made = [made_scene(scene_id).rows for scene_id in scene_ids]
    return {
        table: table_of_rows(table, [row for rows in made for row in rows[table]]).to_pylist() for table in LABEL_TABLES
    }


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda data: data, None),
        (
            lambda data: data.replace(b'"fx":525.0', b'"fx":525.5'),
            "differs from the tables at views.aligned.fx, views.input.fx",
        ),
        (lambda data: data.replace(b'"fx":525.0', b'"fx":525'), "differs from the tables at views.aligned.fx"),
        (lambda data: data.replace(b",-0.0,", b",0.0,"), "differs from the tables at scene.T_world_obj.12"),
        (lambda data: data.replace(b'"split":"train",', b'"split":"test",'), "split"),
        (lambda data: data.replace(b'"patch_object_fraction":null,', b""), None),
        (
            lambda data: data.replace(b'"parent_id"', b'"parent_ie"'),
            "differs from the tables at views.aligned.parent_id",
        ),
        (lambda data: None, "is missing"),
        (lambda data: data[:-9], "is no label: "),
        (lambda data: b"[]", "is no label: "),
    ],
)
def test_labels_that_differ_from_the_tables_are_told_by_pose_and_key(store, tmp_path, change, told):
    attempt_at(store, 0, 4, TAR).commit()
    category = made_scene(0).rows["scenes"][0]["category"]
    data = forged(tmp_path / category / "0000000000.tar", "00000.json", change)
    faults = check_labels(category, data, "here.tar", range_rows_of(range(4)))
    if told is None:
        assert faults == []
    else:
        ((pose_id, fault),) = faults
        assert pose_id == 0 and fault.startswith("here.tar: 00000.json ") and told in fault, fault


def test_labels_of_a_pose_that_the_tables_do_not_have_are_told(store, tmp_path):
    attempt_at(store, 0, 4, TAR).commit()
    (path,) = tmp_path.glob(f"{made_scene(0).rows['scenes'][0]['category']}/*.tar")
    faults = check_labels(path.parent.name, path.read_bytes(), "here.tar", range_rows_of(range(1, 4)))
    assert faults[0] == (0, "here.tar: 00000.json is of a pose that the tables do not have")


def test_a_member_that_is_no_file_is_told(store):
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        link = tarfile.TarInfo("00000.RGB.png")
        link.type, link.linkname = tarfile.SYMTYPE, "00001.RGB.png"
        archive.addfile(link)
    with pytest.raises(CorruptError, match=r"00000.RGB.png is no file"):
        list(read_tar("mug", out.getvalue(), "here.tar"))


def test_images_of_a_range_without_tars_are_read_alike(store):
    record = attempt_at(store, 0, 4).commit().record
    assert dict(read_images(store, record)) == {
        file.path: file.data for i in range(4) for file in scene(i).files if not file.path.startswith("assets/")
    }

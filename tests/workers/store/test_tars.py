"""Archives of images with labels beside them: what a label holds is what the tables say, to the last bit of every double."""

import io
import json
import tarfile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.layout import IMAGES, image_path, patch_path, tar_path
from schemas.errors import CorruptError
from tests.kit.stored_images import read_images
from tests.made_up_scenes import attempt_at, made_scene, scene, terms
from workers.store.local import LocalStore
from workers.store.manifest import table_of_rows
from workers.store.tars import (
    LABEL_TABLES,
    check_labels,
    encode_label,
    member_of,
    path_of,
    pose_labels,
    read_tar,
)

pytestmark = pytest.mark.usefixtures("unflushed")

TAR = terms(layout="tar")
CATEGORY = made_scene(0).rows["scenes"][0]["category"]


def rows_of(*scene_ids: int) -> dict[str, list[dict]]:
    """The rows of these scenes as Arrow gives them."""
    made = [made_scene(scene_id).rows for scene_id in scene_ids]
    return {t: table_of_rows(t, [row for rows in made for row in rows[t]]).to_pylist() for t in LABEL_TABLES}


def members_of(path):
    """With nothing but the standard library."""
    with tarfile.open(path) as archive:
        return [(header, archive.extractfile(header).read()) for header in archive]


def archive_of(*members: tuple[tarfile.TarInfo, bytes]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for header, data in members:
            header.size = len(data)
            archive.addfile(header, io.BytesIO(data))
    return out.getvalue()


def test_a_label_repeats_the_rows_of_the_views_that_share_its_number_and_of_their_objects():
    rows = rows_of(7)
    labels = pose_labels(rows)
    category = rows["scenes"][0]["category"]
    assert {key: sorted(label["views"]) for key, label in labels.items()} == {
        (category, 14): ["aligned", "input", "projected"],
        (category, 15): ["mirror"],
    }
    for label in labels.values():
        for role, view in label["views"].items():
            (row,) = (row for row in rows["views"] if row["role"] == role)
            own = [one for one in rows["objects"] if one["role"] == role]
            assert row.keys() - view.keys() == {"files", "scene_id", "category"}
            assert all(row[name] == value for name, value in view.items() if name != "objects")
            assert [one["region_id"] for one in view["objects"]] == sorted(one["region_id"] for one in own)
            assert view["objects"][0].items() <= own[0].items()
        assert label["scene"]["T_world_obj"] == rows["scenes"][0]["T_world_obj"]
        assert label["assets"].keys() == {row["instance_id"] for row in rows["assets"]}
    assert pose_labels(rows | {"scenes": []}) == {}, "a view without its scene has no label"


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
    assert (in_category, path_of(category, member)) == (category, path)
    assert member.split(".")[:2] == [f"{pose_id:05d}", content]


def test_member_names_are_those_of_the_contract_and_what_is_no_image_has_none():
    assert member_of("mug/depthAligned00042.png") == ("mug", "00042.depthAligned.png")
    assert member_of("mug/patches/RGB00042obj1.png") == ("mug", "00042.RGB.patch.obj1.png")
    assert tar_path("mug", 16) == "mug/0000000016.tar"
    assert tar_path("mug", 16, retry=2) == "mug/0000000016.retry-2.tar"
    for path in ("mug/picture00001.png", "mug/RGB1.png", "mug/RGB00001.jpg", "RGB00001.png", "a/b/RGB00001.png"):
        with pytest.raises(ValueError, match="is not the name of an image"):
            member_of(path)


def test_there_is_one_tar_for_each_range_and_category_the_same_whoever_makes_it(store, tmp_path):
    record = attempt_at(store, 0, 8, TAR).commit().record
    files = [file for i in range(8) for file in scene(i).files if not file.path.startswith("assets/")]
    assert dict(read_images(store, record)) == {file.path: file.data for file in files}
    tars = {entry.path: entry for entry in record.files if entry.path.endswith(".tar")}
    assert tars.keys() == {f"{file.path.split('/')[0]}/0000000000.tar" for file in files}
    assert not list(tmp_path.glob("*/*.png")) and list(tmp_path.glob("assets/*/*.glb"))

    def reversed_files(scene_id):
        output = scene(scene_id)
        return type(output)(scene_id, output.files[::-1], output.rows)

    other = LocalStore(tmp_path / "other")
    again = attempt_at(other, 0, 8, TAR, reversed_files).commit().record
    assert {entry.path: entry for entry in again.files if entry.path.endswith(".tar")} == tars


def test_a_tar_alone_is_enough_to_train_from_and_its_members_have_no_time_or_owner(store, tmp_path):
    attempt_at(store, 0, 8, TAR).commit()
    seen = 0
    for path in tmp_path.glob("*/*.tar"):
        members = members_of(path)
        attributes = {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode, m.type) for m, _ in members}
        assert attributes == {(0, 0, 0, "", "", 0o644, tarfile.REGTYPE)}
        samples: dict[str, dict[str, bytes]] = {}  # as WebDataset groups them: by what stands before the first point
        for header, data in members:
            key, _, ending = header.name.partition(".")
            samples.setdefault(key, {})[ending] = data
        names = [header.name for header, _ in members]
        assert list(samples) == sorted(samples) and names == [f"{key}.{end}" for key in samples for end in samples[key]]
        for key, sample in samples.items():
            assert list(sample)[:4] == ["RGB.png", "RGB.patch.png", "depth.png", "depth.patch.png"]
            assert list(sample)[-1] == "json" and sample["RGB.png"] and sample["depth.png"]
            rows = made_scene(int(key) // 2).rows
            stored = {table: table_of_rows(table, rows[table]).to_pylist() for table in LABEL_TABLES}
            assert json.loads(sample["json"]) == json.loads(
                encode_label(pose_labels(stored)[path.parent.name, int(key)])
            )
            seen += 1
    assert seen == 2 * 7  # scene 5 fails


def test_labels_that_differ_from_the_tables_are_told_by_pose_and_key(store, tmp_path):
    attempt_at(store, 0, 4, TAR).commit()
    rows, path = rows_of(*range(4)), tmp_path / CATEGORY / "0000000000.tar"
    off = "differs from the tables at"
    for change, message in (
        (lambda data: data, None),
        (lambda data: data.replace(b'"fx":525.0', b'"fx":525.5'), f"{off} views.aligned.fx, views.input.fx"),
        (lambda data: data.replace(b'"fx":525.0', b'"fx":525'), f"{off} views.aligned.fx"),
        (lambda data: data.replace(b",-0.0,", b",0.0,"), f"{off} scene.T_world_obj.12"),
        (lambda data: data.replace(b'"split":"train",', b'"split":"test",'), "split"),
        (lambda data: data.replace(b'"patch_object_fraction":null,', b""), None),
        (lambda data: data.replace(b'"parent_id"', b'"parent_ie"'), f"{off} views.aligned.parent_id"),
        (lambda data: None, "is missing"),
        (lambda data: data[:-9], "is no label: "),
        (lambda data: b"[]", "is no label: "),
        (lambda data: b"[" * 100_000, "is no label: it is nested"),
        (lambda data: b"\xff", "is no label: "),
    ):
        members = [(h, change(data) if h.name == "00000.json" else data) for h, data in members_of(path)]
        forged = archive_of(*((header, data) for header, data in members if data is not None))
        faults = check_labels(CATEGORY, forged, "here.tar", rows)
        assert [pose_id for pose_id, _ in faults] == ([] if message is None else [0])
        assert all(fault.startswith("here.tar: 00000.json ") and message in fault for _, fault in faults), message
    faults = check_labels(CATEGORY, path.read_bytes(), "here.tar", rows_of(1, 2, 3))
    assert faults[0] == (0, "here.tar: 00000.json is of a pose that the tables do not have")


def test_a_torn_or_foreign_tar_is_told_by_name(store, tmp_path):
    attempt_at(store, 0, 4, TAR).commit()
    link = tarfile.TarInfo("00000.RGB.png")
    link.type, link.linkname = tarfile.SYMTYPE, "00001.RGB.png"
    for data, message in (
        ((tmp_path / CATEGORY / "0000000000.tar").read_bytes()[:700], ""),
        (archive_of((tarfile.TarInfo("../../etc/passwd"), b"")), ""),
        (archive_of((link, b"")), ".*00000.RGB.png is no file"),
    ):
        with pytest.raises(CorruptError, match=rf"here.tar is not a whole archive{message}"):
            list(read_tar("mug", data, "here.tar"))

import io
import tarfile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.layout import IMAGES, image_path, patch_path, tar_path
from schemas.errors import CorruptError
from tests.made_up_scenes import attempt_at, made_scene, scene, terms
from tests.stored_images import read_images
from workers.store.local import LocalStore
from workers.store.tars import member_of, path_of, read_tar

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
        assert [m.name for m in members][:4] == [
            f"{poses[0]:05d}.{n}.png" for n in ("RGB", "RGB.patch", "depth", "depth.patch")
        ]


def test_images_of_a_range_without_tars_are_read_alike(store):
    record = attempt_at(store, 0, 4).commit().record
    assert dict(read_images(store, record)) == {
        file.path: file.data for i in range(4) for file in scene(i).files if not file.path.startswith("assets/")
    }

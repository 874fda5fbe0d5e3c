import pytest

from schemas.errors import CaptureError
from workers.capture.results import digest_inputs, list_inputs, write_results


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "mug"
    (path / "truth").mkdir(parents=True)
    for name in (
        "camera.json",
        "capture.json",
        "rgb_00000.png",
        "depth_00000.png",
        "rgb_00001.png",
        "truth/truth.json",
    ):
        (path / name).write_text(name)
    (path / "board.json").write_text('{"dictionary": "mine.yml"}')
    (path / "mine.yml").write_text("markers")
    return path


@pytest.mark.parametrize("name", ["rgb_00001.png", "camera.json", "board.json", "mine.yml", "truth/truth.json"])
def test_another_byte_of_any_input_is_another_capture(folder, name):
    before = digest_inputs(folder)
    (folder / name).write_text((folder / name).read_text() + " ")
    assert digest_inputs(folder) != before


def test_a_file_more_or_less_or_under_another_name_is_another_capture(folder):
    digests = {digest_inputs(folder)}
    (folder / "mask_00001.png").write_text("m")
    digests.add(digest_inputs(folder))
    (folder / "mask_00001.png").rename(folder / "mask_00000.png")
    digests.add(digest_inputs(folder))
    (folder / "rgb_00001.png").unlink()
    digests.add(digest_inputs(folder))
    assert len(digests) == 4


def test_neither_the_folders_path_nor_what_was_written_beside_it_changes_the_digest(folder):
    before = digest_inputs(folder)
    written = {"cloud.ply": b"c", "mesh.ply": b"m", "board_00000.txt": b"1 0", "mask_00000.png": b"p"}
    assert write_results(folder, written, {}) == []
    (folder / "notes.txt").write_text("mine")
    assert digest_inputs(folder) == before
    moved = folder.rename(folder.with_name("elsewhere"))
    assert digest_inputs(moved) == before


def test_what_the_user_changed_among_the_results_is_an_input(folder):
    write_results(folder, {"correction_00000.txt": b"1 0"}, {})
    before = digest_inputs(folder)
    (folder / "correction_00000.txt").write_text("1 1")
    assert digest_inputs(folder) != before


def test_names_are_listed_in_one_order(folder):
    names = [file.relative_to(folder).as_posix() for file in list_inputs(folder)]
    assert names == sorted(names)
    assert "mine.yml" in names


def test_a_folder_that_is_gone_is_named(tmp_path):
    with pytest.raises(CaptureError, match="nowhere"):
        digest_inputs(tmp_path / "nowhere")

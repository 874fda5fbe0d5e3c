import numpy as np
import pytest

from schemas.errors import InputError
from services.cli.main import main
from services.read.contact_sheet import COLUMNS, draw_sheet
from services.read.dataset_reader import find_scene


def test_a_sheet_paints_every_object_in_its_own_colour(three_objects):
    sheet = np.asarray(draw_sheet(three_objects, 1))
    column = sheet[26:, 92 + 2 * 260 : 92 + 2 * 260 + 256].reshape(-1, 3)
    for colour in ([230, 70, 40], [45, 110, 200], [60, 160, 70]):
        assert (np.abs(column.astype(int) - colour).max(axis=1) < 8).sum() > 20


def test_a_sheet_has_a_row_for_each_scene_of_the_category(three_objects):
    for name, rows in ((None, 1), (find_scene(three_objects, 0).rows["scenes"][0]["category"], 1)):
        assert draw_sheet(three_objects, 5, name).size == (92 + len(COLUMNS) * 260, 26 + rows * 196)


def test_a_category_without_scenes_is_refused(three_objects):
    with pytest.raises(InputError, match="no scene of category 'none' yet: `verso status"):
        draw_sheet(three_objects, 5, "none")


def test_the_command_writes_a_picture_and_refuses_a_name_that_is_none(three_objects, tmp_path, capsys):
    assert main(["sheet", str(three_objects.root), str(tmp_path / "a.jpg"), "--scenes", "2"]) == 0
    assert (tmp_path / "a.jpg").read_bytes()[:2] == b"\xff\xd8"
    assert main(["sheet", str(three_objects.root), str(tmp_path / "a.txt")]) == 2
    assert "name it .jpg or .png" in capsys.readouterr().err

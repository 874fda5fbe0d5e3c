import numpy as np

from services.read.contact_sheet import COLUMNS, draw_sheet
from services.read.dataset_reader import find_scene


def test_a_sheet_paints_every_object_in_its_own_colour(three_objects):
    sheet = np.asarray(draw_sheet(three_objects, 1))
    column = sheet[26:, 92 + 2 * 260 : 92 + 2 * 260 + 256].reshape(-1, 3)
    for colour in ([230, 70, 40], [45, 110, 200], [60, 160, 70]):
        assert (np.abs(column.astype(int) - colour).max(axis=1) < 8).sum() > 20


def test_a_sheet_has_a_row_for_each_scene_of_the_category(three_objects):
    for name, rows in ((None, 1), ("none", 0), (find_scene(three_objects, 0).rows["scenes"][0]["category"], 1)):
        assert draw_sheet(three_objects, 5, name).size == (92 + len(COLUMNS) * 260, 26 + rows * 196)

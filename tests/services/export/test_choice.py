import pytest

from schemas.errors import InputError
from services.export.formats import Choice, Chooser
from services.export.source import iter_ranges
from workers.store.commit import list_codes


def chosen(store, **asked):
    chooser = Chooser(Choice(**asked))
    return [scene for one in iter_ranges(store, list_codes(store), 0) for scene in chooser.choose(one)]


def test_conditions_narrow_each_other(files):
    assert chosen(files) == [0, 1, 2, 3]
    cans = chosen(files, categories=("can",))
    assert chosen(files, categories=("can",), where="scene_id > 1") == [one for one in cans if one > 1]
    assert chosen(files, first_scene=1, last_scene=2, where="scene_id <> 2") == [1]
    assert chosen(files, categories=("mug",)) == []


def test_a_condition_may_ask_the_other_tables_about_its_scene(files):
    asks = "scene_id in (select scene_id from views where role = 'input' and pose_id >= 8)"
    assert chosen(files, where=asks) == [2, 3]


def test_a_condition_on_captures_may_name_their_column(captures):
    assert chosen(captures, where="capture.views >= 1") == [0, 1]


@pytest.mark.parametrize("where", ["nosuch = 1", "category =", "scene_id in (select * from read_csv('/etc/passwd'))"])
def test_a_condition_that_cannot_be_asked_is_refused_before_anything_is_read(where):
    with pytest.raises(InputError, match="cannot be asked"):
        Chooser(Choice(where=where))

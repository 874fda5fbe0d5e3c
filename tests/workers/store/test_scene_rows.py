"""What two attempts at a scene are held against each other by."""

import numpy as np
import pytest

from tests.made_up_scenes import made_scene
from workers.store.scene_rows import scene_digest


def rows():
    return made_scene(3).rows


def test_the_digest_of_a_scene_knows_no_order_of_rows_or_keys_and_no_type_of_number():
    base = rows()
    turned = {
        table: [dict(reversed(row.items())) for row in reversed(found)] for table, found in reversed(base.items())
    }
    turned["scenes"][0]["penetration_mm"] = np.float64(turned["scenes"][0]["penetration_mm"])
    turned["scenes"][0]["redraws"] = np.int64(turned["scenes"][0]["redraws"])
    assert scene_digest(turned) == scene_digest(base)


@pytest.mark.parametrize("table", ["timings", "assets"])
def test_timings_and_shapes_are_no_part_of_it(table):
    assert scene_digest({**rows(), table: []}) == scene_digest(rows())


@pytest.mark.parametrize(("table", "column"), [("scenes", "settle_s"), ("views", "d_z_m"), ("objects", "u")])
def test_the_last_bit_of_any_number_is_part_of_it(table, column):
    other = rows()
    value = other[table][0][column]
    other[table][0][column] = value + 1 if isinstance(value, int) else float(np.nextafter(value, np.inf))
    assert scene_digest(other) != scene_digest(rows())

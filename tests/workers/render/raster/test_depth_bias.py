"""Which things stand back, and by how many steps."""

import numpy as np
import trimesh

from schemas.scene.camera import Camera
from schemas.scene.scene import Placed
from tests.shapes import shape_of
from tests.workers.render.random_scenes import APPEARANCE, VGA
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import translation
from workers.render.raster.depth_bias import rank_regions

CUBE = shape_of(trimesh.creation.box((0.1, 0.1, 0.1)))
CORNERS = CUBE.vertices


def cubes(*spots: tuple[float, float, float], first: int = 3) -> list[Placed]:
    return [Placed(first + k, CUBE, translation(*spot)) for k, spot in enumerate(spots)]


def ranks(things: list[Placed]) -> dict[int, int]:
    return rank_regions(things, [CORNERS] * len(things))


def test_a_stack_stands_back_step_by_step_and_what_stands_beside_it_does_not():
    assert ranks(cubes((0, 0, 0), (0, 0, 0.1), (0, 0, 0.2), (1, 0, 0.2))) == {3: 0, 4: 1, 5: 2, 6: 0}


def test_twenty_things_side_by_side_stand_back_as_far_as_one_alone():
    plate = Placed(2, shape_of(trimesh.creation.box((9.0, 9.0, 0.1))), translation(0, 0, -0.1))
    things = [plate, *cubes(*((0.2 * k, 0.0, 0.0) for k in range(20)))]
    found = rank_regions(things, [plate.shape.vertices, *[CORNERS] * 20])
    assert found == {2: 0, **dict.fromkeys(range(3, 23), 1)}


def test_the_order_that_things_come_in_and_two_of_one_region_make_no_difference():
    things = cubes((0, 0, 0), (0, 0, 0.1), (0, 0, 0.2))
    again = [*things[::-1], Placed(3, CUBE, translation(5, 5, 5))]
    assert ranks(things) == ranks(things[::-1]) == ranks(again) == {3: 0, 4: 1, 5: 2}
    assert ranks([]) == {}


def test_the_twentieth_of_many_is_not_lost_behind_what_it_lies_closely_over(renderer):
    """A plate 0.05 mm above another and seen from 2.5 m hides it, however many others there are."""
    flat = shape_of(trimesh.creation.box((0.3, 0.3, 0.001)))
    far = cubes(*((0.2 * k - 1.0, 1.0, 0.0) for k in range(19)))
    things = [Placed(2, flat, np.eye(4)), *far, Placed(22, flat, translation(0.0, 0.0, 0.00005))]
    camera = Camera(VGA, orbit_pose(np.zeros(3), 0.8, 0.3, 2.5))
    region = renderer.draw(things, APPEARANCE, camera).region
    alone = renderer.draw(things[-1:], APPEARANCE, camera).region
    seen = region[alone == 22]
    assert len(seen) > 2000
    assert (seen == 22).mean() > 0.98  # all but the plate's lower edge

"""The judge reads meshes that a stranger's tool might leave: inside out, sharing edges or walls, or open."""

import numpy as np
import pytest

from schemas.scene.shape import Mesh
from tests.judge.judge import Thing, judge
from tests.judge.solids import ball, box, joined, moved
from tests.judge.surface import surface

FLOOR = box((1.0, 1.0, 0.1), (0.0, 0.0, -0.05))
CUBE = box((0.1, 0.1, 0.1), (0.0, 0.0, 0.05))


def found_of(mesh: Mesh, deep_m: float = 0.0):
    low = moved(mesh, at=(0.0, 0.0, -deep_m))
    middle = (low.vertices.min(axis=0) + low.vertices.max(axis=0)) / 2
    return judge([Thing(low, 1.0, middle)], FLOOR, 0.25)[0]


def inside_out(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[:, ::-1])


def unwelded(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3))


WHOLE = {
    "inside out": inside_out(CUBE),
    "one body inside out": joined(inside_out(CUBE), moved(CUBE, at=(0.2, 0.0, 0.0))),
    "without welds": unwelded(CUBE),
    "two on one edge": joined(CUBE, moved(CUBE, at=(0.1, 0.1, 0.0))),
    "two with one wall": joined(CUBE, moved(CUBE, at=(0.1, 0.0, 0.0))),
    "every face twice": joined(CUBE, CUBE),
    "every face from both sides": joined(CUBE, inside_out(CUBE)),
}


CUBES = dict.fromkeys(WHOLE, 1) | dict.fromkeys(("one body inside out", "two on one edge", "two with one wall"), 2)


@pytest.mark.parametrize("name", WHOLE)
def test_a_closed_mesh_is_a_body_however_it_is_written(name):
    read = surface(WHOLE[name])
    assert not read.open.any()
    assert sum(solid.volume() for solid in read.solids) == pytest.approx(CUBES[name] * 1e-3)
    found = found_of(WHOLE[name])
    assert max(found.overlap_mm, found.hover_mm) < 1e-9 and found.unbalanced < 1e-6
    assert found_of(WHOLE[name], 5e-6).overlap_mm == pytest.approx(5e-3, abs=1e-6)


OPEN = {
    "cube without a lid": Mesh(CUBE.vertices, CUBE.faces[CUBE.vertices[CUBE.faces][:, :, 2].min(axis=1) < 0.1 - 1e-9]),
    "sheet": Mesh(
        np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]]), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    ),
}


@pytest.mark.parametrize("name", OPEN)
@pytest.mark.parametrize("turned", [False, True])
def test_an_open_mesh_rests_and_is_as_deep_in_the_ground_as_its_lowest_point(name, turned):
    mesh = inside_out(OPEN[name]) if turned else OPEN[name]
    assert surface(mesh).open.all()
    found = found_of(mesh)
    assert max(found.overlap_mm, found.hover_mm) < 1e-9 and found.unbalanced < 1e-6
    assert found_of(mesh, 5e-6).overlap_mm == pytest.approx(5e-3, abs=1e-6)
    assert found_of(mesh, -2e-5).hover_mm == pytest.approx(2e-2, abs=1e-6)


def test_a_ball_in_a_cube_without_a_lid_is_not_inside_it():
    shell, one = OPEN["cube without a lid"], ball(0.02, (0.0, 0.0, 0.02))
    things = [Thing(shell, 1.0, np.array([0.0, 0.0, 0.05])), Thing(one, 1.0, np.array([0.0, 0.0, 0.02]))]
    found = judge(things, FLOOR, 0.25)
    assert found[1].overlap_mm == 0.0 and found[1].hover_mm == pytest.approx(0.0, abs=1e-9)
    assert max(each.unbalanced for each in found) < 1e-6

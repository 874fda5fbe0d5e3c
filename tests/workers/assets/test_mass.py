"""Mass properties against solids whose integrals are known, and against trimesh where they are not."""

import math

import numpy as np
import pytest
import trimesh

from tests.workers.assets.oracles import shape_of
from workers.assets.mass import mass_properties, shell_mass, solid_mass


def box_inertia(mass, x, y, z):
    """Of a solid box about its centre."""
    return np.diag([mass * (y * y + z * z), mass * (x * x + z * z), mass * (x * x + y * y)]) / 12.0


def test_a_box_has_the_inertia_of_the_textbook():
    mass = mass_properties(shape_of(trimesh.creation.box((0.2, 0.3, 0.5))), 600.0, 3.0)
    assert mass.solid
    assert mass.mass_kg == pytest.approx(18.0, rel=1e-12)
    assert mass.com == pytest.approx(np.zeros(3), abs=1e-15)
    assert mass.inertia == pytest.approx(box_inertia(18.0, 0.2, 0.3, 0.5), rel=1e-12, abs=1e-15)


def test_moving_a_solid_moves_its_centre_of_mass_and_nothing_else():
    mesh = trimesh.creation.box((0.2, 0.3, 0.5))
    mesh.apply_translation((10.0, -20.0, 30.0))
    mass = mass_properties(shape_of(mesh), 600.0, 3.0)
    assert mass.com == pytest.approx([10.0, -20.0, 30.0], rel=1e-12)
    assert mass.inertia == pytest.approx(box_inertia(18.0, 0.2, 0.3, 0.5), rel=1e-9, abs=1e-12)


def test_turning_a_solid_turns_its_inertia():
    R = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.7, 0.1]))
    mesh = trimesh.creation.box((0.2, 0.3, 0.5), transform=R)
    mass = mass_properties(shape_of(mesh), 600.0, 3.0)
    expected = R[:3, :3] @ box_inertia(18.0, 0.2, 0.3, 0.5) @ R[:3, :3].T
    assert mass.inertia == pytest.approx(expected, rel=1e-10, abs=1e-14)


def test_finer_spheres_come_closer_to_the_ball_by_a_quarter_each_time():
    exact_mass, radius = 1000.0 * 4 / 3 * math.pi * 0.1**3, 0.1
    errors = []
    for level in (2, 3, 4):
        mass = mass_properties(shape_of(trimesh.creation.icosphere(level, radius)), 1000.0, 3.0)
        exact = 0.4 * exact_mass * radius**2
        errors.append((1 - mass.mass_kg / exact_mass, 1 - mass.inertia[0, 0] / exact))
    ratios = np.array(errors[1:]) / np.array(errors[:-1])
    assert ratios == pytest.approx(np.full((2, 2), 0.25), abs=0.02)


def test_a_closed_vessel_weighs_its_wall_and_not_its_void():
    outer, void = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((0.8, 0.8, 0.8))
    void.apply_translation((0, 0, 0.05))
    void.invert()
    mass = mass_properties(shape_of(outer, void), 10.0, 3.0)
    assert mass.solid
    assert mass.mass_kg == pytest.approx(10.0 * (1.0 - 0.512), rel=1e-12)
    assert mass.com[2] == pytest.approx(-0.05 * 0.512 / (1.0 - 0.512), rel=1e-9)


def test_where_two_bodies_overlap_both_weigh():
    one, two = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    two.apply_translation((0.5, 0, 0))
    mass = mass_properties(shape_of(one, two), 1.0, 3.0)
    assert mass.mass_kg == pytest.approx(2.0, rel=1e-12)
    assert mass.com == pytest.approx([0.25, 0, 0], abs=1e-12)


def test_one_solid_cut_into_parts_weighs_as_one():
    mesh = trimesh.creation.icosphere(3, 0.2)
    upper = mesh.triangles_center[:, 2] > 0
    halves = [mesh.submesh([np.flatnonzero(side)], append=True) for side in (upper, ~upper)]
    cut, whole = mass_properties(shape_of(*halves), 600.0, 3.0), mass_properties(shape_of(mesh), 600.0, 3.0)
    assert cut.solid
    assert cut.mass_kg == pytest.approx(whole.mass_kg, rel=1e-12)
    assert cut.inertia == pytest.approx(whole.inertia, rel=1e-12, abs=1e-12)


def test_a_spherical_shell_has_two_thirds_m_r_squared():
    exact_mass = 3.0 * 4 * math.pi * 0.1**2
    mesh = trimesh.creation.icosphere(5, 0.1)
    mass = shell_mass(mesh.vertices, mesh.faces, 3.0)
    assert not mass.solid
    assert mass.mass_kg == pytest.approx(exact_mass, rel=1e-3)
    assert mass.inertia == pytest.approx(np.eye(3) * 2 / 3 * exact_mass * 0.01, rel=2e-3, abs=1e-6)


def test_an_open_box_is_five_plates():
    mesh = trimesh.creation.box((2.0, 2.0, 2.0))
    lid = mesh.triangles_center[:, 2] > 0.999
    mesh.update_faces(~lid)
    mass = mass_properties(shape_of(mesh), 600.0, 3.0)
    plate = 3.0 * 4.0
    assert not mass.solid
    assert mass.mass_kg == pytest.approx(5 * plate, rel=1e-12)
    assert mass.com == pytest.approx([0, 0, -0.2], abs=1e-12)
    # About z: the bottom m (a^2 + b^2)/12, four walls m (a^2/12 + 1) with a = b = 2; about z the shift does nothing.
    assert mass.inertia[2, 2] == pytest.approx(plate * (8 / 12 + 4 * (4 / 12 + 1)), rel=1e-12)


def test_a_cone_balances_at_a_quarter_of_its_height_with_the_inertia_of_the_textbook():
    r, h, segments = 0.3, 0.8, 256
    mesh = trimesh.creation.cone(r, h, sections=segments)
    mass = solid_mass(mesh.vertices, mesh.faces, 500.0)
    m = 500.0 * math.pi * r * r * h / 3
    assert mass.mass_kg == pytest.approx(m, rel=2e-4)
    assert mass.com == pytest.approx([0, 0, h / 4], abs=1e-4)
    # About the centre of mass: 3/80 m (4 r^2 + h^2) across, 3/10 m r^2 along the axis.
    across, along = 3 / 80 * m * (4 * r * r + h * h), 0.3 * m * r * r
    assert np.diag(mass.inertia) == pytest.approx([across, across, along], rel=1e-3)


def test_a_solid_of_any_shape_agrees_with_trimesh():
    mesh = trimesh.creation.annulus(0.03, 0.05, 0.1)
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.2, 0.9])))
    mesh.apply_translation((0.4, 0.1, -0.2))
    mesh.density = 600.0
    mass = solid_mass(mesh.vertices, mesh.faces, 600.0)
    assert mass.mass_kg == pytest.approx(mesh.mass, rel=1e-10)
    assert mass.com == pytest.approx(mesh.center_mass, rel=1e-10)
    assert mass.inertia == pytest.approx(mesh.moment_inertia, rel=1e-8, abs=1e-12)

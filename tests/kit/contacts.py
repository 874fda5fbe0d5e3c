"""Meshes at places, and the contacts that production finds between two of them."""

import numpy as np
import trimesh

from schemas.base import Array
from schemas.scene.shape import MassProperties, Mesh
from workers.geometry.frames import pose, rotation_about, transform
from workers.physics.contact_surface import is_closed, surface_of
from workers.physics.contacts import Contacts, contacts_within
from workers.physics.exact_rest import Thing

UP = np.array([0.0, 0.0, 1.0])


def mesh_of(body, T=None) -> Mesh:
    vertices = np.asarray(body.vertices, dtype=np.float64)
    return Mesh(vertices if T is None else transform(T, vertices), np.asarray(body.faces, dtype=np.int32))


def box(sides, at=(0.0, 0.0, 0.0), turn=None) -> Mesh:
    T = pose(np.eye(3) if turn is None else turn, np.array(at, dtype=np.float64))
    return mesh_of(trimesh.creation.box(sides), T)


def tipped(angle_rad: float) -> Array:
    """About the y axis: the side that looks to +x sinks."""
    return rotation_about(np.array([0.0, 1.0, 0.0]), angle_rad)


def contacts_between(meshes: list[Mesh], within_m: float) -> Contacts:
    """Of meshes in world coordinates, the last of which is the ground."""
    surfaces = [surface_of(mesh, is_closed(mesh)) for mesh in meshes]
    return contacts_within(surfaces, [np.eye(4)] * len(surfaces), within_m)


def thing_of(mesh: Mesh, mass_kg: float = 1.0) -> Thing:
    """A body of even density, by trimesh."""
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    com, tensor = np.array(body.center_mass), np.array(body.moment_inertia) * mass_kg / body.volume
    return Thing(surface_of(mesh, is_closed(mesh)), MassProperties(mass_kg, com, tensor, True))

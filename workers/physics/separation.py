"""Distance or overlap of objects with the table and with one another, between their true meshes. Pure."""

import itertools
from collections.abc import Iterator, Sequence
from functools import cached_property

import manifold3d
import numpy as np

from schemas.base import Pose
from schemas.scene.shape import Mesh
from workers.geometry.contact_surface import Surface, is_closed, surface_of
from workers.geometry.convexity import mesh_of, solid_of, weld
from workers.geometry.frames import transform
from workers.geometry.hull import convex_hull, least_width_m
from workers.geometry.manifold import hold_to_one_thread
from workers.physics.rest.contacts import contacts_within

FARTHEST_M = 0.01
"""Farthest distance that is measured: CoACD's parts stand out of a surface by less."""

NEAR_M = 1e-3
"""Distance within which others are looked for first: what rests has one."""

NO_VOLUME = 1e-15
"""Cubic metres of overlap that are rounding alone."""


class Form:
    """A mesh with what its rest is found and measured by, made when first asked for.

    `mesh` may be a part of a `whole`, which decides what is inside. `closed`: known to have an inside.
    """

    def __init__(self, mesh: Mesh, whole: Mesh | None = None, closed: bool = False) -> None:
        self.mesh, self._whole, self._closed = mesh, whole or mesh, closed

    @cached_property
    def surface(self) -> Surface:
        """The features that may touch others."""
        return surface_of(self.mesh, self._closed or is_closed(self._whole))

    @cached_property
    def solid(self) -> manifold3d.Manifold | None:
        """The body that the mesh encloses; None where it encloses none, as a part of one."""
        return solid_of(self.surface.welded if self._whole is self.mesh else weld(self._whole))

    @cached_property
    def body(self) -> manifold3d.Manifold:
        """The body that the mesh encloses, or else that of its hull."""
        hold_to_one_thread()
        return self.solid or manifold3d.Manifold.hull_points(np.ascontiguousarray(self.mesh.vertices))


def find_gaps_m(forms: Sequence[Form], poses: Sequence[Pose]) -> list[float]:
    """For each form, at its pose [4, 4], the metres to the nearest other; minus the depth where it overlaps.

    The distance is that of a corner from a face or of two edges that cross, and `FARTHEST_M` where nothing is nearer. The
    depth is `overlap_m` for two solids, else that of the deepest corner or edge.
    """
    # A table need not be made a solid where no object is one, as the underside of one
    some = any(form.solid is not None for form in forms[:-1])
    solid = np.array([some and form.solid is not None for form in forms])
    gaps = [FARTHEST_M] * len(forms)
    for within_m in (NEAR_M, FARTHEST_M):
        contacts = contacts_within([form.surface for form in forms], poses, within_m)
        known = np.where(solid[contacts.upper] & solid[contacts.lower], np.maximum(contacts.gaps, 0.0), contacts.gaps)
        gaps = [min(FARTHEST_M, float(known[contacts.of(k)].min(initial=np.inf))) for k in range(len(forms))]
        if max(gaps) <= within_m:
            break
    for i, j in _find_near(forms, poses) if some else ():
        a, b = forms[i].solid, forms[j].solid
        if a is not None and b is not None and (depth_m := overlap_m(_place(a, poses[i]), _place(b, poses[j]))):
            gaps[i], gaps[j] = min(gaps[i], -depth_m), min(gaps[j], -depth_m)
    return gaps


def find_overlaps_m(forms: Sequence[Form], poses: Sequence[Pose]) -> Iterator[tuple[int, int, float]]:
    """(i, j, `overlap_m`) of every two forms whose boxes overlap; what encloses no body counts as its hull."""
    for i, j in _find_near(forms, poses):
        yield i, j, overlap_m(_place(forms[i].body, poses[i]), _place(forms[j].body, poses[j]))


def overlap_m(a: manifold3d.Manifold, b: manifold3d.Manifold) -> float:
    """The thickness of the thickest piece of the intersection of two bodies, metres; 0 where they have none.

    Its least width, or 6 V / A of its volume and area where that is less, as for a piece that is bent: three times the
    thickness of a plate, and the thickness of a cone or a cube.
    """
    hold_to_one_thread()
    pieces = [piece for piece in (a ^ b).decompose() if piece.volume() > NO_VOLUME]
    return max(
        (
            min(least_width_m(convex_hull(mesh_of(piece).vertices)), 6.0 * piece.volume() / piece.surface_area())
            for piece in pieces
        ),
        default=0.0,
    )


def _find_near(forms: Sequence[Form], poses: Sequence[Pose]) -> Iterator[tuple[int, int]]:
    """The numbers i < j of every two forms whose bounding boxes overlap."""
    if len(forms) < 2:
        return
    points = [transform(T, form.mesh.vertices[form.mesh.faces.ravel()]) for form, T in zip(forms, poses, strict=True)]
    boxes = [(each.min(axis=0, initial=np.inf), each.max(axis=0, initial=-np.inf)) for each in points]
    for i, j in itertools.combinations(range(len(forms)), 2):
        if (boxes[i][0] <= boxes[j][1]).all() and (boxes[j][0] <= boxes[i][1]).all():
            yield i, j


def _place(solid: manifold3d.Manifold, T: Pose) -> manifold3d.Manifold:
    return solid.transform(np.ascontiguousarray(T[:3]))

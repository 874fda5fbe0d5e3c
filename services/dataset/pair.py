"""A pair as a user of the data meets it: frozen facts of its scene, its views, and what both views tell together."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.dataset.codec import Row, read_world_poses
from schemas.errors import InputError
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import ROLES, Role
from services.dataset.correspondence import Correspondence, correspond
from services.dataset.view import Files, Frame, View, pick, read_mesh, read_view, sample_mesh
from workers.geometry.frames import invert, transform

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Pair:
    """An input pose and its mirror pose with all their views; None where the dataset has no such view.

    `scene`: every column of the row of `scenes`; `asset`: of the row of `assets` of the (first) object. docs/columns.md
    says what they mean.
    """

    pose_id: int
    """The input view's, even; the mirror view's is the next."""
    scene_id: int
    category: str
    instance_id: str
    scene: Mapping[str, Any] = field(repr=False)
    asset: Mapping[str, Any] = field(repr=False)
    views: Mapping[Role, View] = field(repr=False)
    """Every view there is, by role; those of the article have names of their own below."""
    _files: Files = field(repr=False)

    @property
    def input(self) -> View:
        """What the camera sees."""
        return self.views["input"]

    @property
    def aligned(self) -> View | None:
        """What the depth camera beside it sees."""
        return self.views.get("aligned")

    @property
    def mirror(self) -> View | None:
        """What is on the other side."""
        return self.views.get("mirror")

    @property
    def projected(self) -> View | None:
        """The input view's points, as the mirror camera sees them."""
        return self.views.get("projected")

    @cached_property
    def T_world(self) -> Mapping[int, Pose]:
        """[4, 4] float64 pose in the world of the table (2) and of every object (3 and up), by region id, metres."""
        return MappingProxyType(read_world_poses(self.scene))

    def mesh(
        self, region: int = REGION_FIRST_OBJECT, view: View | None = None, *, welded: bool = False
    ) -> "trimesh.Trimesh":
        """An object's shape (or the table's, 2) where it rests: in the world, or in the frame of a view's camera, metres.

        welded: one vertex at each place and no look, for what needs a closed surface. Stored shapes have several at the seams
        of their textures and normals, so that trimesh calls them not watertight. Raises InputError where there is no such
        region, or where its shape is stored nowhere.
        """
        T = self._pose_of(region)
        mesh = read_mesh(self._files, self.scene, region, welded)
        return mesh.apply_transform(T if view is None else np.linalg.inv(view.T_world_cam) @ T)

    def samples(self, region: int = REGION_FIRST_OBJECT) -> Mapping[str, NDArray]:
        """The stored samples of an object's shape, in its own frame, metres, by name: `surface_points` [N, 3] and so on.

        Raises InputError where none are stored.
        """
        self._pose_of(region)
        if not (stored := self._files.samples(self.scene, region)):
            raise InputError(f"no samples of region {region} are stored: a job stores those that targets.shape names")
        return stored

    def _pose_of(self, region: int) -> Pose:
        """[4, 4] pose in the world. Raises InputError where there is no such region."""
        if region not in self.T_world:
            raise InputError(f"scene {self.scene_id} has the regions {sorted(self.T_world)}, and no {region}")
        return self.T_world[region]

    def correspondence(self, back: bool = False, *, tolerance_m: float = 0.001) -> Correspondence:
        """Where every pixel of the input view lies in the mirror view and whether it is seen there; the other way with `back`.

        A point is seen where the pixel that it falls in shows its region, and where it lies at most `tolerance_m` behind the
        surface there: 1 mm is five steps of exact depth, noisy or captured depth needs more. Right but for a pixel along
        outlines, and surfaces within ten degrees of edge-on. Raises InputError where the job has no mirror view.
        """
        if self.mirror is None:
            raise InputError(f"pair {self.pose_id} has no mirror view: the job's cameras.mirror.enabled is false")
        source, target = (self.mirror, self.input) if back else (self.input, self.mirror)
        return correspond(source, target, tolerance_m)

    def flow(self, back: bool = False) -> Array:
        """[H, W, 2] float64: how far, pixels, each pixel of the input view moves to the mirror view; nan where not known.

        Also of what the mirror view does not see: `correspondence` tells.
        """
        return self.correspondence(back).flow()

    def partial_and_complete(
        self, n: int, seed: int = 0, *, frame: Frame = "object", region: int = REGION_FIRST_OBJECT
    ) -> tuple[Array, Array]:
        """(n points of the input view's cloud, n of the object's whole surface), each [n, 3] float64, in one frame, metres.

        The surface's are of the stored `surface_points`, or uniform over the stored mesh without them. Points are drawn
        anew from those there are; only of fewer than `n` some are drawn again. Raises InputError where the view sees no point.
        """
        seen = self.input.cloud(frame, region).points
        if n < 1:
            raise InputError(f"n is {n}: it must be at least 1")
        if not len(seen):
            raise InputError(
                f"the input view of pair {self.pose_id} has no depth of region {region}: choose another pair"
            )
        rng = np.random.default_rng(seed)
        partial, stored = pick(seen, n, rng), self._files.samples(self.scene, region)
        if "surface_points" in stored:
            whole = pick(stored["surface_points"].astype(np.float64), n, rng)
        else:
            whole = sample_mesh(read_mesh(self._files, self.scene, region, False), n, seed)
        T_frame_cam, T_cam_world = self.input.T_frame_cam(frame, region), invert(self.input.T_world_cam)
        return partial, transform(T_frame_cam @ T_cam_world @ self.T_world[region], whole)


def read_pair(row: Row, labels: Mapping[tuple[int, str], list[Row]], files: Files) -> Pair:
    """The pair of a row of `pair_table`; `labels`: rows of `objects`, with that of `assets`, by (pose id, role)."""
    scene = MappingProxyType({name: value for name, value in row.items() if name not in (*ROLES, "asset", "parent_id")})
    return Pair(
        pose_id=row["parent_id"],
        scene_id=row["scene_id"],
        category=row["category"],
        instance_id=row["instance_id"],
        scene=scene,
        asset=MappingProxyType(row["asset"] or {}),
        views=MappingProxyType(
            {role: read_view(row[role], labels, scene, files) for role in ROLES if row[role] is not None}
        ),
        _files=files,
    )

"""A pair as a user of the data meets it: frozen facts of its scene, its views by name, and what both views tell together.

Correspondence is where the pixels of one view lie in another, and whether they are seen there, from the stored images of both.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.dataset.codec import Row, read_world_poses
from schemas.dataset.layout import PixelKind, view_name
from schemas.errors import InputError
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import ROLES, Role
from services.dataset.view import Files, Frame, Pixels, View, pick, read_mesh, read_view
from workers.geometry.camera import project, unproject
from workers.geometry.frames import invert, transform

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Where every pixel of one image lies in another.

    uv [H, W, 2] float64: image coordinates there, pixels, the centre of the first pixel at (0.5, 0.5), also outside of the
    image; nan where the pixel has no depth, or lies behind the other camera. visible [H, W] bool: whether the other camera
    sees the same point.
    """

    uv: Array
    visible: NDArray[np.bool_]

    def flow(self) -> Array:
        """[H, W, 2] float64: `uv` minus the pixel's own centre, pixels."""
        rows, columns = np.indices(self.visible.shape)
        return self.uv - np.stack([columns + 0.5, rows + 0.5], axis=2)


def carry(
    source: Pixels,
    target: Pixels,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    z_m: Array,
    region: NDArray[np.uint8],
    tolerance_m: float,
) -> tuple[Array, NDArray[np.bool_]]:
    """(uv [N, 2], visible [N]) as in `Correspondence`, of N pixels of the source with depth z_m [N] and these regions [N].

    A point is seen where the pixel that it falls in shows its region, and where it lies no more than `tolerance_m` behind
    what `farthest_surface` expects there.
    """
    T_target_source = invert(target.T_world_cam) @ source.T_world_cam
    points = transform(T_target_source, unproject(rows, columns, z_m, source.camera.intrinsics))
    uv, visible = np.full((len(points), 2), np.nan), np.zeros(len(points), np.bool_)
    ahead = np.flatnonzero(points[:, 2] > 0.0)
    k, there = target.camera.intrinsics, target.segment()
    u, v = project(points[ahead], k)
    uv[ahead, 0], uv[ahead, 1] = u, v
    inside = (u >= 0.0) & (u < k.width) & (v >= 0.0) & (v < k.height)
    inside[inside] = there[v[inside].astype(np.int64), u[inside].astype(np.int64)] == region[ahead[inside]]
    if inside.any():
        at, u, v = ahead[inside], u[inside], v[inside]
        # Only the part of the image about these pixels: an object has one pixel in a hundred.
        top, left = max(int(v.min()) - 2, 0), max(int(u.min()) - 2, 0)
        near = slice(top, int(v.max()) + 3), slice(left, int(u.max()) + 3)
        depth_m = target.depth()[near] / target.depth_units_per_m
        visible[at] = points[at, 2] <= tolerance_m + farthest_surface(depth_m, there[near], u - left, v - top, k.fx)
    return uv, visible


def farthest_surface(depth_m: Array, region: NDArray[np.uint8], u: Array, v: Array, focal_px: float) -> Array:
    """[N] float64: how far away, metres, the surface may be that is seen at image coordinates u, v [N] inside of an image.

    depth_m, region [H, W]; -inf where the pixel has no depth. On a plane 1/z is linear in the image, so it is carried on
    from the pixel's centre by the steps to the next pixels along row and column. Where the surface bends between pixels,
    that may be wrong by as much as the steps differ: the lesser of the differences before and after, as much as a fold of
    two planes makes; none beside another region, and at most one pixel's width at that depth, so that an outline nearby does
    not count as a bend.
    """
    inverse = np.pad(
        np.divide(1.0, depth_m, out=np.full(depth_m.shape, np.nan), where=depth_m > 0.0), 2, constant_values=np.nan
    )
    label = np.pad(region, 2)
    row, column = np.floor(v).astype(np.int64), np.floor(u).astype(np.int64)
    own, here = region[row, column], inverse[row + 2, column + 2]
    there, bend = here.copy(), np.zeros(len(u))
    for off, down, right in ((v - row - 0.5, 1, 0), (u - column - 0.5, 0, 1)):
        side = np.where(off < 0.0, -1, 1)
        before, after, beyond = (
            np.where(label[at] == own, inverse[at], np.nan)
            for at in ((row + 2 + n * side * down, column + 2 + n * side * right) for n in (-1, 1, 2))
        )
        last, step, following = here - before, after - here, beyond - after
        there += np.abs(off) * np.nan_to_num(np.where(np.isnan(step), last, step))
        bend += np.nan_to_num(np.minimum(np.abs(step - last), np.abs(following - step)))
    z = 1.0 / there
    return np.nan_to_num(z + np.minimum(bend * z * z, z / focal_px), nan=-np.inf)


@dataclass(frozen=True, eq=False)
class NamedViews(Sequence[View]):
    """The N views of a camera that the job names, in order of their numbers; as arrays stacked over them."""

    views: tuple[View, ...]

    def __getitem__(self, number):  # type: ignore[no-untyped-def]
        return self.views[number]

    def __len__(self) -> int:
        return len(self.views)

    @property
    def T_world_cam(self) -> Array:
        """[N, 4, 4] float64: camera coordinates (x right, y down, z forward) to world coordinates, metres."""
        return np.stack([view.T_world_cam for view in self.views])

    @property
    def K(self) -> Array:
        """[N, 3, 3] float64 intrinsics, pixels; the centre of pixel (column i, row j) is at (i + 0.5, j + 0.5)."""
        return np.stack([view.K for view in self.views])

    def image(self, kind: PixelKind) -> NDArray:
        """[N, H, W] or [N, H, W, C]: the images of any kind, as `View.image`."""
        return self._stack(lambda view: view.image(kind))

    def rgb(self) -> NDArray[np.uint8]:
        """[N, H, W, 3] uint8 sRGB."""
        return self._stack(View.rgb)

    def alpha(self) -> NDArray[np.uint8]:
        """[N, H, W] uint8: the share of each pixel that is covered, as 255."""
        return self._stack(View.alpha)

    def depth_m(self) -> NDArray[np.float32]:
        """[N, H, W] float32: z along the optical axis, metres; 0 where unknown."""
        return self._stack(View.depth_m)

    def segment(self) -> NDArray[np.uint8]:
        """[N, H, W] uint8 region ids."""
        return self._stack(View.segment)

    def normals(self) -> NDArray[np.float32]:
        """[N, H, W, 3] float32: unit normals in each camera's frame."""
        return self._stack(View.normals)

    def _stack(self, read: Callable[[View], NDArray]) -> NDArray:
        return np.stack([read(view) for view in self.views])


class Views(Mapping[Role, View]):
    """The views of a pair by name: `views["input"]`, `views["around", 3]`, and all of a camera by `views("around")`."""

    def __init__(self, views: Mapping[str, View]) -> None:
        self._views = views

    def __getitem__(self, name: str | tuple[str, int]) -> View:
        return self._views[name if isinstance(name, str) else view_name(*name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def __call__(self, name: str) -> NamedViews:
        """All views of a camera that the job names. Raises InputError naming those that there are."""
        named = {view.role: 0 for view in self._views.values() if view.number is not None}
        if name not in named:
            there = f"it has {', '.join(named)}" if named else "its job has no cameras.more"
            raise InputError(f"this pair has no views of a camera named {name!r}: {there}")
        return NamedViews(tuple(view for view in self._views.values() if view.role == name))


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
    views: Views = field(repr=False)
    """Every view there is, by role; those of the article have names of their own below. `views["around", 3]` and
    `views("around")` are of a camera that the job names, with the first pair of each scene."""
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
        units, region = source.depth(), source.segment()
        rows, columns = np.nonzero(units)
        z_m = units[rows, columns] / source.depth_units_per_m
        uv, visible = np.full((*units.shape, 2), np.nan), np.zeros(units.shape, np.bool_)
        uv[rows, columns], visible[rows, columns] = carry(
            source, target, rows, columns, z_m, region[rows, columns], tolerance_m
        )
        return Correspondence(uv, visible)

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
            from trimesh.sample import sample_surface  # takes as long to load as all the rest

            mesh = read_mesh(self._files, self.scene, region, False)
            whole = np.asarray(sample_surface(mesh, n, seed=seed)[0], np.float64)
        T_frame_cam, T_cam_world = self.input.T_frame_cam(frame, region), invert(self.input.T_world_cam)
        return partial, transform(T_frame_cam @ T_cam_world @ self.T_world[region], whole)


def read_pair(row: Row, labels: Mapping[tuple[int, str], list[Row]], files: Files, further: Sequence[Row] = ()) -> Pair:
    """The pair of a row of `pair_table`; `labels`: rows of `objects`, with that of `assets`, by (pose id, name of the view).

    further: rows of `views` of named cameras.
    """
    scene = MappingProxyType({name: value for name, value in row.items() if name not in (*ROLES, "asset", "parent_id")})
    return Pair(
        pose_id=row["parent_id"],
        scene_id=row["scene_id"],
        category=row["category"],
        instance_id=row["instance_id"],
        scene=scene,
        asset=MappingProxyType(row["asset"] or {}),
        views=Views(
            {role: read_view(row[role], labels, scene, files) for role in ROLES if row[role] is not None}
            | {view.name: view for view in (read_view(more, labels, scene, files) for more in further)}
        ),
        _files=files,
    )

"""A pair as a user of the data meets it: frozen facts of its scene and views, and images that are decoded when asked for."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.dataset.codec import Row, read_camera, read_label, read_world_poses
from schemas.dataset.layout import PixelKind, file_pose_id, patch_index
from schemas.errors import InputError
from schemas.job.views import Patch
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import ROLES, Camera, ObjectLabel, Role, crop_box
from services.read.stored_tables import patch_paths, view_paths
from workers.store.images import decode_png

if TYPE_CHECKING:
    import trimesh


class Files(Protocol):
    """Where the files of a pair come from."""

    patch: Patch
    """The size of patches in this dataset."""

    def image(self, scene_id: int, path: str) -> bytes:
        """The bytes of an image. Raises CorruptError where it is missing."""

    def mesh(self, scene: Row, region_id: int) -> "trimesh.Trimesh":
        """The shape of a region (2 the table, 3 and up the objects) in its own frame, metres."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """The images of one camera: of a whole view, or of its crop about an object.

    `camera` is that of these pixels: a crop's principal point counts from its own corner.
    """

    camera: Camera = field(repr=False)
    depth_units_per_m: float = field(repr=False)
    _paths: Mapping[PixelKind, str] = field(repr=False)
    _scene_id: int = field(repr=False)
    _files: Files = field(repr=False)

    @property
    def K(self) -> Array:
        """[3, 3] float64 intrinsics, pixels; the centre of pixel (column i, row j) is at (i + 0.5, j + 0.5)."""
        k = self.camera.intrinsics
        return np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])

    @property
    def K_opencv(self) -> Array:
        """[3, 3] float64 intrinsics, pixels, for software that puts pixel centres on whole numbers, as OpenCV does."""
        k = self.camera.intrinsics
        return np.array([[k.fx, 0.0, k.cx_opencv], [0.0, k.fy, k.cy_opencv], [0.0, 0.0, 1.0]])

    @property
    def T_world_cam(self) -> Pose:
        """[4, 4] float64: camera coordinates (x right, y down, z forward) to world coordinates, metres."""
        return self.camera.T_world_cam

    @property
    def images(self) -> Mapping[PixelKind, str]:
        """Paths below the dataset's folder of the images that there are, by kind: rgb, depth, region."""
        return self._paths

    def image(self, kind: PixelKind) -> NDArray:
        """The pixels of an image of any kind in `images`, as they are stored.

        Raises InputError where the dataset has no such image, CorruptError where it is damaged.
        """
        if kind not in self._paths:
            raise InputError(f"this view has no image of kind {kind!r}, only {', '.join(self._paths) or 'none'}")
        path = self._paths[kind]
        return decode_png(self._files.image(self._scene_id, path), path)

    def rgb(self) -> NDArray[np.uint8]:
        """[H, W, 3] uint8 sRGB."""
        return self.image("rgb")

    def depth(self) -> NDArray[np.uint16]:
        """[H, W] uint16: z along the optical axis as it is stored, in units of 1 / `depth_units_per_m`; 0 where unknown."""
        return self.image("depth")

    def depth_m(self) -> NDArray[np.float32]:
        """[H, W] float32: z along the optical axis, metres; 0 where unknown."""
        return (self.depth() / self.depth_units_per_m).astype(np.float32)

    def segment(self) -> NDArray[np.uint8]:
        """[H, W] uint8 region ids: 0 nothing, 1 floor, 2 table, 3 and up the objects."""
        return self.image("region")


@dataclass(frozen=True, eq=False)
class View(Pixels):
    """One view of a pair: its camera, its labels, its images. Every column of its row of `views` is in `row`."""

    role: Role
    pose_id: int
    d_z_m: float
    visible_fraction: float | None
    """Of the (first) object's own unoccluded pixels; None of projected views."""
    objects: tuple[ObjectLabel, ...] = field(repr=False)
    """Labels of the table (region 2) and of every object; the projected view has the mirror view's."""
    row: Mapping[str, Any] = field(repr=False)

    def patch(self, region_id: int = REGION_FIRST_OBJECT) -> Pixels | None:
        """The stored crop about an object; None where it would leave the image, or where the object is not seen."""
        label = next((one for one in self.objects if one.region_id == region_id), None)
        if label is None or region_id < REGION_FIRST_OBJECT:
            known = [one.region_id for one in self.objects if one.region_id >= REGION_FIRST_OBJECT]
            raise InputError(f"region {region_id} is no object of this view; its objects are {known}")
        box = crop_box(label, self.camera, self._files.patch)
        if box is None:
            return None
        objects = sum(one.region_id >= REGION_FIRST_OBJECT for one in self.objects)
        k = self.camera.intrinsics
        size = {"width": self._files.patch.width, "height": self._files.patch.height}
        moved = k.model_copy(update={**size, "cx": k.cx - box[1].start, "cy": k.cy - box[0].start})
        paths = patch_paths(self.row, patch_index(region_id, objects))
        return Pixels(
            Camera(moved, self.camera.T_world_cam), self.depth_units_per_m, paths, self._scene_id, self._files
        )


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
        self, region_id: int = REGION_FIRST_OBJECT, view: View | None = None, *, welded: bool = False
    ) -> "trimesh.Trimesh":
        """An object's shape (or the table's, 2) where it rests: in the world, or in the frame of a view's camera, metres.

        welded: one vertex at each place and no look, for what needs a closed surface. Stored shapes have several at the seams
        of their textures and normals, so that trimesh calls them not watertight. Raises InputError where there is no such
        region, or where its shape is stored nowhere.
        """
        if region_id not in self.T_world:
            raise InputError(f"scene {self.scene_id} has the regions {sorted(self.T_world)}, and no {region_id}")
        mesh = self._files.mesh(dict(self.scene), region_id)
        if welded:
            mesh = weld(mesh)
        T = self.T_world[region_id]
        mesh.apply_transform(T if view is None else np.linalg.inv(view.T_world_cam) @ T)
        return mesh


def weld(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """The surface with one vertex at each place, without triangles of two corners and without colours."""
    import trimesh  # takes as long to load as all the rest

    places, at = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = at.reshape(-1)[mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return trimesh.Trimesh(places, faces[whole], process=False)


def read_pair(row: Row, labels: Mapping[tuple[int, str], list[Row]], files: Files) -> Pair:
    """The pair of a row of `pair_table`; `labels`: rows of `objects` by (pose id, role)."""
    scene = {name: value for name, value in row.items() if name not in (*ROLES, "asset", "parent_id")}
    return Pair(
        pose_id=row["parent_id"],
        scene_id=row["scene_id"],
        category=row["category"],
        instance_id=row["instance_id"],
        scene=MappingProxyType(scene),
        asset=MappingProxyType(row["asset"] or {}),
        views=MappingProxyType({role: _read_view(row[role], labels, files) for role in ROLES if row[role] is not None}),
        _files=files,
    )


def _read_view(row: Row, labels: Mapping[tuple[int, str], list[Row]], files: Files) -> View:
    labelled: Role = "mirror" if row["role"] == "projected" else row["role"]
    pose_id = file_pose_id(labelled, row["parent_id"])
    return View(
        camera=read_camera(row),
        depth_units_per_m=row["depth_units_per_m"],
        _paths=view_paths(row),
        _scene_id=row["scene_id"],
        _files=files,
        role=row["role"],
        pose_id=row["pose_id"],
        d_z_m=row["d_z_m"],
        visible_fraction=row["visible_fraction"],
        objects=tuple(read_label(one) for one in labels.get((pose_id, labelled), ())),
        row=MappingProxyType(row),
    )

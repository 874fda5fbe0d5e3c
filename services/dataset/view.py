"""A view as a user of the data meets it: its camera and labels, and images and what follows from them when asked for.

Points in space, too: what its pixels see as a cloud, the box about an object, samples of a whole surface.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.dataset.codec import Row, read_camera, read_label, read_matrix
from schemas.dataset.layout import PixelKind, file_pose_id, patch_index, view_name
from schemas.errors import InputError
from schemas.job.views import Patch
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE, is_object
from schemas.scene.view import FULL, LAYERS, MODALITIES, Camera, ObjectLabel, Role, crop_box
from services.read.dataset_reader import patch_paths, view_paths
from workers.geometry.camera import project, unproject
from workers.geometry.frames import invert, transform
from workers.store.images import decode_png

if TYPE_CHECKING:
    import trimesh

Frame = Literal["object", "camera", "world"]
"""The frame of points: an object's own, the camera's (x right, y down, z forward), or the world (z up); metres in all."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """What the pixels of a view see, a point for each pixel with depth, row after row.

    points [N, 3] float64, metres; colours [N, 3] uint8 sRGB, None without RGB; normals [N, 3] float64, unit, towards the
    camera, None without the target `normals`; pixels [N, 2] int64, row and column, so that `image[tuple(cloud.pixels.T)]` are
    the points' values in any image of the view.
    """

    points: Array
    colours: NDArray[np.uint8] | None
    normals: Array | None
    pixels: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Box:
    """The corners of the box about an object that lies along the axes of the object's frame.

    corners [8, 3] float64 in the camera's frame, metres; image [8, 2] float64, their (u, v) in pixels, also outside of the
    image, nan where a corner is not before the camera. Corner 4 i + 2 j + k is at the lower (0) or upper (1) end along the
    object's x (i), y (j) and z (k).
    """

    corners: Array
    image: Array


def pick(points: Array, count: int, rng: np.random.Generator) -> Array:
    """[count, 3]: some of points [N, 3], N > 0, in random order; none twice, unless there are fewer than `count`."""
    return points[rng.choice(len(points), count, replace=len(points) < count)]


class Files(Protocol):
    """Where the files of a pair come from."""

    patch: Patch
    """The size of patches in this dataset."""

    def image(self, path: str) -> bytes:
        """The bytes of an image. Raises CorruptError where it is missing."""

    def mesh(self, scene: Mapping[str, Any], region: int) -> "trimesh.Trimesh":
        """The shape of a region (2 the table, 3 and up the objects) in its own frame, metres."""

    def samples(self, scene: Mapping[str, Any], region: int) -> Mapping[str, NDArray]:
        """The stored samples of the same shape by name; none where none are stored."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """The images of one camera: of a whole view, or of its crop about an object.

    `camera` is that of these pixels: a crop's principal point counts from its own corner.
    """

    camera: Camera = field(repr=False)
    depth_units_per_m: float = field(repr=False)
    regions: Mapping[int, Mapping[str, Any]] = field(repr=False)
    """By region id, of the table (2) and of every object (3 and up): its row of `objects`, and its row of `assets` as `asset`."""
    _paths: Mapping[PixelKind, str] = field(repr=False)
    _scene: Mapping[str, Any] = field(repr=False)
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
        """The pixels of an image of any kind in `images`, as they are stored. Raises as `png`, and for damage."""
        return decode_png(self.png(kind), self._paths[kind])

    def png(self, kind: PixelKind) -> bytes:
        """The file of an image of any kind in `images`.

        Raises InputError where the dataset has no such image, CorruptError where it is missing.
        """
        if kind not in self._paths:
            target = MODALITIES[kind].target if kind in MODALITIES and "region" in self._paths else None
            others = "" if not target or MODALITIES[kind].of_input else ", of views beside the input's"
            hint = f": a job stores it whose targets.views names {target}{others}" if target else ""
            raise InputError(f"this view has no image of kind {kind!r}, only {', '.join(self._paths) or 'none'}{hint}")
        return self._files.image(self._paths[kind])

    def rgb(self) -> NDArray[np.uint8]:
        """[H, W, 3] uint8 sRGB; where alpha is stored, colours that it does not darken."""
        return self.image("rgb")[:, :, :3]

    def alpha(self) -> NDArray[np.uint8]:
        """[H, W] uint8: the share of each pixel that is covered, as 255. Raises InputError where none is stored."""
        pixels = self.image("rgb")
        if pixels.shape[2] < 4:
            raise InputError(
                "this view's RGB has no alpha: a job of scene studio stores it with studio.background transparent"
            )
        return pixels[:, :, 3]

    def depth(self) -> NDArray[np.uint16]:
        """[H, W] uint16: z along the optical axis as it is stored, in units of 1 / `depth_units_per_m`; 0 where unknown."""
        return self.image("depth")

    def depth_m(self) -> NDArray[np.float32]:
        """[H, W] float32: z along the optical axis, metres; 0 where unknown."""
        return (self.depth() / self.depth_units_per_m).astype(np.float32)

    def segment(self) -> NDArray[np.uint8]:
        """[H, W] uint8 region ids: 0 nothing, 1 floor, 2 table, 3 and up the objects."""
        return self.image("region")

    def normals(self) -> NDArray[np.float32]:
        """[H, W, 3] float32: unit normals in the camera's frame, towards the camera; 0 where there is none."""
        codes = self.image("normals")  # (n + 1) / 2, and 0 where there is none
        normals = codes.astype(np.float32)
        normals *= np.float32(2.0 / FULL)
        normals -= np.float32(1.0)
        length = np.sqrt(np.einsum("ijk,ijk->ij", normals, normals))
        normals /= np.where(_coded(codes), length, np.float32(np.inf))[:, :, None]
        return normals

    def coordinates(self) -> Array:
        """[H, W, 3] float64: where on its object each pixel is, metres in the object's frame; nan where no object is seen."""
        codes, mask = self.image("coordinates"), self.segment()
        points, at = np.full(codes.shape, np.nan), np.flatnonzero(_coded(codes))
        some, region = codes.reshape(-1, 3)[at], mask.ravel()[at]
        for region_id, row in self.regions.items():
            if row["coordinates_scale_m"] is not None:
                own = region == region_id
                placed = some[own] * (row["coordinates_scale_m"] / FULL) + row["coordinates_offset_m"]
                points.reshape(-1, 3)[at[own]] = placed
        return points

    def albedo(self) -> NDArray[np.uint8]:
        """[H, W, 3] uint8 sRGB: base colours without light and shadow."""
        return self.image("albedo")

    def covisible(self) -> NDArray[np.bool_]:
        """[H, W] bool: where the pair's input camera sees the point of an object that the pixel's centre shows."""
        mask: NDArray[np.bool_] = self.image("covisible") > 0
        return mask

    def layers(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """(depth [N, H, W] float32, metres along the optical axis, 0 for none; region [N, H, W]) of the objects' surfaces.

        From front to back along each pixel's ray: both sides of every face of every object count, floor and table do not.
        """
        count = max(1, sum(f"layer{n}" in self._paths for n in LAYERS))
        depth = np.stack([self.image(f"layer{n}") for n in LAYERS[:count]])
        region = np.stack([self.image(f"layer{n}_region") for n in LAYERS[:count]])
        return (depth / self.depth_units_per_m).astype(np.float32), region

    def thickness_m(self) -> NDArray[np.float32]:
        """[H, W] float32: from the first surface along a pixel's ray to the last one, metres along the ray, hollows included.

        nan but where the mask shows an object and every stored layer, and the last surface, is of that object.
        """
        (depth_m, regions), mask = self.layers(), self.segment()
        back_m, back_region = self.image("back") / self.depth_units_per_m, self.image("back_region")
        counts = is_object(mask) & (regions[0] == mask) & (back_region == mask)
        counts &= ((regions == mask) | (regions == 0)).all(axis=0) & (depth_m[0] > 0.0) & (back_m > 0.0)
        rows, columns = np.nonzero(counts)
        rays = unproject(rows, columns, np.ones(len(rows)), self.camera.intrinsics)
        thickness = np.full(mask.shape, np.nan, np.float32)
        thickness[counts] = (back_m - depth_m[0])[counts] * np.linalg.norm(rays, axis=1)
        return thickness

    def cloud(self, frame: Frame = "object", region: int | None = REGION_FIRST_OBJECT) -> Cloud:
        """The points that the pixels of a region see (of all regions for None), from the stored depth.

        Colours are those of the same pixels, which `sensor.distortion` of a job moves in RGB alone. Raises InputError where
        the view has no such region, or no mask to tell regions by.
        """
        if region not in (None, REGION_FLOOR):
            self._labelled(region)
        T, units = self.T_frame_cam(frame, region), self.depth()
        rows, columns = np.nonzero((units > 0) if region is None else (units > 0) & (self.segment() == region))
        points = unproject(rows, columns, units[rows, columns] / self.depth_units_per_m, self.camera.intrinsics)
        colours = self.rgb()[rows, columns] if "rgb" in self._paths else None
        normals = self.normals()[rows, columns] @ T[:3, :3].T if "normals" in self._paths else None
        return Cloud(transform(T, points), colours, normals, np.stack([rows, columns], axis=1))

    def box(self, region: int = REGION_FIRST_OBJECT) -> Box:
        """The box about an object, or the table (2), along the axes of its own frame. Raises InputError for another region."""
        row = self._labelled(region)
        ends = np.array(list(product((-0.5, 0.5), repeat=3))) * row["asset"]["extents_m"]
        corners = transform(read_matrix(row["T_cam_obj"]), ends)
        image, ahead = np.full((8, 2), np.nan), corners[:, 2] > 0.0
        image[ahead] = np.stack(project(corners[ahead], self.camera.intrinsics), axis=1)
        return Box(corners, image)

    def mesh(self, region: int = REGION_FIRST_OBJECT, *, welded: bool = False) -> "trimesh.Trimesh":
        """An object's whole shape (or the table's, 2) in the frame of this camera, metres; as `Pair.mesh`."""
        T_cam_obj = read_matrix(self._labelled(region)["T_cam_obj"])
        return read_mesh(self._files, self._scene, region, welded).apply_transform(T_cam_obj)

    def _labelled(self, region: int | None, first: int = REGION_TABLE) -> Mapping[str, Any]:
        """What is known of a region. Raises InputError where the view has no label of it, or its id is below `first`."""
        known = [region_id for region_id in sorted(self.regions) if region_id >= first]
        if region not in known:
            kind = "object" if first == REGION_FIRST_OBJECT else "object or table"
            raise InputError(f"region {region} is no {kind} of this view; its {kind}s are {known}")
        return self.regions[region]

    def T_frame_cam(self, frame: Frame, region: int | None = REGION_FIRST_OBJECT) -> Pose:
        """[4, 4]: camera coordinates to those of a frame, metres; the object's is that of a region."""
        if frame == "object":
            return invert(read_matrix(self._labelled(region)["T_cam_obj"]))
        if frame not in ("camera", "world"):
            raise InputError(f"there is no frame {frame!r}: frames are object, camera and world")
        return self.T_world_cam if frame == "world" else np.eye(4)


def _coded(codes: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """[H, W]: which pixels of an image [H, W, 3] hold anything, at 10 times the speed of `any` along the last axis."""
    return (codes[..., 0] | codes[..., 1] | codes[..., 2]) > 0


@dataclass(frozen=True, eq=False)
class View(Pixels):
    """One view of a pair: its camera, its labels, its images. Every column of its row of `views` is in `row`."""

    role: Role
    number: int | None
    """Of a named camera's view, among those of its role; else None."""
    pose_id: int
    d_z_m: float
    visible_fraction: float | None
    """Of the (first) object's own unoccluded pixels; None of projected views."""
    objects: tuple[ObjectLabel, ...] = field(repr=False)
    """Labels of the table (region 2) and of every object; the projected view has the mirror view's."""
    row: Mapping[str, Any] = field(repr=False)

    @property
    def name(self) -> str:
        """What it is called within its pair: its role, of a named camera with its number."""
        return view_name(self.role, self.number)

    def patch(self, region: int = REGION_FIRST_OBJECT) -> Pixels | None:
        """The stored crop about an object; None where it would leave the image, or where the object is not seen."""
        label = read_label(self._labelled(region, REGION_FIRST_OBJECT))
        box = crop_box(label, self.camera, self._files.patch)
        if box is None:
            return None
        objects = sum(label.region_id >= REGION_FIRST_OBJECT for label in self.objects)
        k = self.camera.intrinsics
        size = {"width": self._files.patch.width, "height": self._files.patch.height}
        moved = k.model_copy(update={**size, "cx": k.cx - box[1].start, "cy": k.cy - box[0].start})
        paths = patch_paths(self.row, patch_index(region, objects))
        camera = Camera(moved, self.camera.T_world_cam)
        return Pixels(camera, self.depth_units_per_m, self.regions, paths, self._scene, self._files)

    def amodal(self, region: int = REGION_FIRST_OBJECT) -> NDArray[np.bool_]:
        """[H, W] bool: where an object would be seen if nothing stood in front of it."""
        self._labelled(region, REGION_FIRST_OBJECT)
        several = f"amodal{region - REGION_FIRST_OBJECT}"
        mask: NDArray[np.bool_] = self.image(several if several in self._paths else "amodal") > 0
        return mask


def read_view(row: Row, labels: Mapping[tuple[int, str], list[Row]], scene: Mapping[str, Any], files: Files) -> View:
    """The view of a row of `views`; the projected view has the labels of the mirror view. `labels` as for `read_pair`."""
    labelled: Role = "mirror" if row["role"] == "projected" else row["role"]
    number = row.get("number")
    own = labels.get((file_pose_id(labelled, row["parent_id"]), view_name(labelled, number)), ())
    return View(
        camera=read_camera(row),
        depth_units_per_m=row["depth_units_per_m"],
        regions=MappingProxyType({label["region_id"]: MappingProxyType(label) for label in own}),
        _paths=view_paths(row),
        _scene=scene,
        _files=files,
        role=row["role"],
        number=number,
        pose_id=row["pose_id"],
        d_z_m=row["d_z_m"],
        visible_fraction=row["visible_fraction"],
        objects=tuple(map(read_label, own)),
        row=MappingProxyType(row),
    )


def read_mesh(files: Files, scene: Mapping[str, Any], region: int, welded: bool) -> "trimesh.Trimesh":
    """The shape of a region in its own frame."""
    mesh = files.mesh(scene, region)
    return weld(mesh) if welded else mesh


def weld(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """The surface with one vertex at each place, without triangles of two corners and without colours."""
    import trimesh  # takes as long to load as all the rest

    places, at = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = at.reshape(-1)[mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return trimesh.Trimesh(places, faces[whole], process=False)

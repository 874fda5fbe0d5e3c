"""Layouts of networks that train on views from several cameras: `zero123`, `instantmesh`, `trellis`, `stereo` (docs/export.md).

The first three show an object alone: RGBA, whose alpha is that of a studio scene, else the pixels of the object. They have the
views of cameras of `cameras.more` that stand by themselves (rings, spheres, poses), of a job without such those of its pairs.
Their frame has the world's axes, z up, the middle of the object's box along these as its origin, and a unit in which the longest
side of that box is `SIDE`; cameras look along -z with y up (OpenGL), as Blender has them.

`stereo` is the layout of Middlebury 2014, which RAFT-Stereo and its successors read: a folder for each rectified pair of views.
"""

import csv
import io
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.ply import export_ply

from schemas.base import Array
from schemas.dataset.codec import read_world_poses
from schemas.errors import InputError
from schemas.job.cameras import More
from schemas.job.job import Job
from services.dataset.pair import Pair
from services.dataset.view import View
from services.export.formats import LeftOut, Writer, encode_json, encode_npy, encode_npz
from services.export.graphics import OPENGL_FROM_OPTICAL
from services.export.objects import NO_SHAPE
from services.export.source import ExportScene, alone, drawn, named
from workers.geometry.frames import invert, transform
from workers.store.images import encode_png

NOT_SQUARE: Final = (
    "a view is not a square picture with the optical axis in its middle, which these loaders take for granted"
)


class Subject(NamedTuple):
    """The object that a folder is of: its region, the layout's unit by metres, and where the world has its frame's origin [3].

    `points` [V, 3] and `faces` are its shape in that frame and unit.
    """

    region_id: int
    unit: float
    origin: Array
    points: Array
    faces: NDArray[np.int32]


class MultiView(Writer):
    """A folder for each object of a scene with its views numbered from 0; `register` lists the folders by split."""

    KEYS: ClassVar = ("render.rgb",)
    FRESH: ClassVar = {"objects": {}, "views": [], "fov_deg": []}
    SIDE: ClassVar[float]
    """Of the object's box, its longest, in the layout's unit."""
    LIST: ClassVar[str]
    """The file that lists the folders of a split."""

    @classmethod
    def check(cls, name: str, job: Job) -> None:
        """Raises InputError where the job lacks a target, or has lens distortion."""
        super().check(name, job)
        if job.sensor.distortion is not None:
            raise InputError(
                f"{name} needs colour of a pinhole camera, and this job has sensor.distortion: make it without"
            )

    def add(self, scene: ExportScene) -> LeftOut:
        """Writes a folder for each object; a scene with a view that the layout cannot hold is left out."""
        standing = {entry.name for entry in self.record.job.cameras.more if entry.beside is None}
        around = [view for pair in scene.pairs for view in named(pair) if view.role in standing]
        views = around or [view for pair in scene.pairs for view in drawn(pair)]
        if not all(map(is_square, views)):
            return [(pair.pose_id, NOT_SQUARE) for pair in scene.pairs]
        placed = ((region_id, self._place(scene, region_id)) for region_id in scene.instances)
        subjects = {region_id: subject for region_id, subject in placed if subject is not None}
        if len(subjects) < len(scene.instances):
            return [(pair.pose_id, NO_SHAPE) for pair in scene.pairs]
        for region_id, self._subject in subjects.items():
            several = f"-{region_id}" if len(subjects) > 1 else ""
            name = f"{scene.instances[region_id][0]}-{scene.scene_id:06d}{several}"
            self.write(scene, name, views)
            self.register.add(scene.split, name)
            self.count("objects", scene.split)
        self.kept["views"] = sorted({*self.kept["views"], len(views)})
        fovs = (round(math.degrees(field_of_view(view)), 4) for view in views)
        self.kept["fov_deg"] = sorted({*self.kept["fov_deg"], *fovs})
        return []

    def _place(self, scene: ExportScene, region_id: int) -> Subject | None:
        """An object in the layout's frame; None where its shape is not to be had."""
        if (shape := self.shapes.load(scene, scene.instances[region_id][1])) is None:
            return None
        points = transform(read_world_poses(scene.row)[region_id], shape.vertices)
        low, high = points.min(axis=0), points.max(axis=0)
        unit, origin = self.SIDE / float((high - low).max()), 0.5 * (low + high)
        return Subject(region_id, unit, origin, unit * (points - origin), shape.faces)

    def write(self, scene: ExportScene, name: str, views: list[View]) -> None:
        """Writes the folder of an object."""
        raise NotImplementedError

    def colour(self, view: View) -> bytes:
        """The RGBA of the object in a view, as PNG."""
        return alone(view, self._subject.region_id)

    def pose(self, view: View) -> Array:
        """[4, 4] camera to the object's frame, OpenGL."""
        T = view.T_world_cam @ OPENGL_FROM_OPTICAL
        T[:3, 3] = self._subject.unit * (T[:3, 3] - self._subject.origin)
        return T

    def depth(self, view: View) -> NDArray[np.float64]:
        """[H, W] z along the optical axis in the layout's unit, 0 where the object is not seen."""
        unit = self._subject.unit / view.depth_units_per_m
        return np.where(view.segment() == self._subject.region_id, unit * view.depth(), 0.0)

    def list_of(self, split: str, names: list[str]) -> bytes:
        """What lists the folders of a split."""
        raise NotImplementedError

    def finish(self) -> None:
        """Writes the list of each split."""
        for split, _ in self.register.counts():
            self.folder.put(f"{split}/{self.LIST}", self.list_of(split, [name for _, name in self.register.of(split)]))

    def describe(self) -> dict[str, Any]:
        """Objects by split, and the conventions."""
        return {
            "objects": self.counts("objects"),
            "views_of_an_object": self.kept["views"],
            "fov_deg": self.kept["fov_deg"],
            "not_exported": ["projected views, patches; what stands beside the object"],
            "frame": f"the world's axes, z up, origin in the middle of the object's box, whose longest side is {self.SIDE:g}",
        }


def is_square(view: View) -> bool:
    """Whether a view is a square picture of square pixels, with the principal point in its middle."""
    k = view.camera.intrinsics
    return k.width == k.height and k.fx == k.fy and k.cx == k.cy == 0.5 * k.width


def field_of_view(view: View) -> float:
    """Horizontal, radians, of a view whose principal point is in the middle."""
    return 2.0 * math.atan(0.5 * view.camera.intrinsics.width / view.camera.intrinsics.fx)


class Zero123(MultiView):
    """Writes <name>/000.png and 000.npy, [3, 4] object to camera, and valid_paths.json."""

    SIDE: ClassVar = 1.0
    LIST: ClassVar = "valid_paths.json"

    def write(self, scene: ExportScene, name: str, views: list[View]) -> None:
        """Writes pictures and poses."""
        folder = f"{scene.split}/{name}"
        for number, view in enumerate(views):
            self.folder.put(f"{folder}/{number:03d}.png", self.colour(view))
            self.folder.put(f"{folder}/{number:03d}.npy", encode_npy(invert(self.pose(view))[:3]))

    def list_of(self, split: str, names: list[str]) -> bytes:
        """The names."""
        return encode_json(names)

    def describe(self) -> dict[str, Any]:
        """What all have, and the poses."""
        return {**super().describe(), "poses": "NNN.npy, [3, 4] object to camera, OpenGL axes"}


class InstantMesh(MultiView):
    """Writes <name>/000.png, 000_normal.png, 000_depth.png and cameras.npz, and filtered_obj_name.json."""

    NEEDS: ClassVar = {"views": ("normals",)}
    SIDE: ClassVar = 2.0
    LIST: ClassVar = "filtered_obj_name.json"
    DEPTH: ClassVar = 6.0
    """The depth of 255."""

    def write(self, scene: ExportScene, name: str, views: list[View]) -> None:
        """Writes pictures, normals and depth, and the poses."""
        folder = f"{scene.split}/rendering_random_32views/{name}"
        for number, view in enumerate(views):
            depth = np.rint(np.clip(self.depth(view) * (255.0 / self.DEPTH), 0.0, 255.0)).astype(np.uint8)
            self.folder.put(f"{folder}/{number:03d}.png", self.colour(view))
            self.folder.put(f"{folder}/{number:03d}_normal.png", encode_png(self._normals(view)))
            self.folder.put(f"{folder}/{number:03d}_depth.png", encode_png(depth))
        poses = np.stack([invert(self.pose(view))[:3] for view in views])
        self.folder.put(f"{folder}/cameras.npz", encode_npz({"cam_poses": poses}))

    def _normals(self, view: View) -> NDArray[np.uint8]:
        """[H, W, 4] world normals as (n + 1) / 2, and where there are any."""
        codes = view.image("normals")
        seen = (view.segment() == self._subject.region_id) & codes.any(axis=2)
        normals = (codes / 32767.5 - 1.0) @ view.T_world_cam[:3, :3].T
        colours = np.where(seen[..., None], np.rint(127.5 * (normals + 1.0)), 0.0)
        return np.concatenate([colours, 255.0 * seen[..., None]], axis=2).astype(np.uint8)

    def list_of(self, split: str, names: list[str]) -> bytes:
        """The names, as objects that are good."""
        return encode_json({"good_objs": names})

    def describe(self) -> dict[str, Any]:
        """What all have, and the encodings."""
        encodings = {"depth": f"8 bits of z, 255 is {self.DEPTH:g}", "normals": "(n + 1) / 2 in the world's axes"}
        return {**super().describe(), "poses": "cam_poses [N, 3, 4], object to camera, OpenGL axes", **encodings}


class Trellis(MultiView):
    """Writes renders/<name> of all views and renders_cond/<name> of input views, each with transforms.json, and metadata.csv."""

    SIDE: ClassVar = 1.0
    LIST: ClassVar = "metadata.csv"

    def write(self, scene: ExportScene, name: str, views: list[View]) -> None:
        """Writes both folders, and the mesh."""
        self._write_views(f"{scene.split}/renders/{name}", views, deep=True)
        if conditions := [pair.input for pair in scene.pairs if self._is_seen(pair.input)]:
            self._write_views(f"{scene.split}/renders_cond/{name}", conditions)
        mesh = trimesh.Trimesh(self._subject.points, self._subject.faces, process=False)
        self.folder.put(f"{scene.split}/renders/{name}/mesh.ply", export_ply(mesh))

    def _is_seen(self, view: View) -> bool:
        """Whether a loader, which cuts the object out, finds it in a view."""
        return view.regions[self._subject.region_id]["pixels"] > 0 and "rgb" in view.images and is_square(view)

    def _write_views(self, folder: str, views: list[View], deep: bool = False) -> None:
        frames = []
        for number, view in enumerate(views):
            T = self.pose(view)
            frame = {"file_path": f"{number:03d}.png", "camera_angle_x": field_of_view(view)}
            frame["transform_matrix"] = T.tolist()
            self.folder.put(f"{folder}/{frame['file_path']}", self.colour(view))
            if deep:
                # From end to end of the sphere about the cube, as that project's own script stores it.
                low, high = (float(np.linalg.norm(T[:3, 3])) + end * math.sqrt(0.75) for end in (-1, 1))
                frame["depth"] = {"min": low, "max": high}
                depth = self.depth(view)
                share = np.where(depth > 0.0, np.clip((depth - low) / (high - low), 0.0, 1.0), 1.0)
                self.folder.put(
                    f"{folder}/{number:03d}_depth.png", encode_png(np.rint(65_535 * share).astype(np.uint16))
                )
            frames.append(frame)
        box = [[-0.5] * 3, [0.5] * 3]
        unit, origin = self._subject.unit, self._subject.origin
        tree = {"aabb": box, "scale": unit, "offset": (-unit * origin).tolist(), "frames": frames}
        self.folder.put(f"{folder}/transforms.json", encode_json(tree))

    def list_of(self, split: str, names: list[str]) -> bytes:
        """A row for each name; what is not known of it yet is False and 0."""
        table = io.StringIO()
        rows = csv.writer(table, lineterminator="\n")
        rows.writerow(["sha256", "aesthetic_score", "rendered", "cond_rendered", "voxelized", "num_voxels"])
        for name in names:
            has_condition = (self.folder.root / split / "renders_cond" / name).exists()
            rows.writerow([name, 0.0, True, has_condition, False, 0])
        return table.getvalue().encode()

    def describe(self) -> dict[str, Any]:
        """What all have, and the encodings."""
        return {
            **super().describe(),
            "poses": "camera to object, OpenGL axes",
            "depth": "16 bits of z between min and max of its frame, 65535 behind the object",
        }


class Stereo(Writer):
    """Writes <scene id>-<pose id>-<camera>/im0.png, im1.png, disp0.pfm, disp1.pfm and calib.txt; im0 is of the left camera."""

    KEYS: ClassVar = ("render.rgb",)
    FRESH: ClassVar = {"folders": {}}

    @classmethod
    def check(cls, name: str, job: Job) -> None:
        """Raises InputError where no camera stands beside another one so that their rows of pixels agree."""
        super().check(name, job)
        if not any(map(is_rectified, job.cameras.more)):
            example = "{name: right, beside: input, offset_m: [0.1, 0, 0]}"
            raise InputError(
                f"{name} needs a camera of cameras.more beside another, along its x axis alone and with its sensor, such as "
                f"{example}; this job has none: make the dataset with one"
            )

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes the folders of a pair, one for each rectified camera."""
        for entry in filter(is_rectified, self.record.job.cameras.more):
            views = [pair.views[entry.beside or ""], pair.views[entry.name, 0]]
            folder = f"{scene.split}/{scene.scene_id:06d}-{pair.pose_id:06d}-{entry.name}"
            for number, view in enumerate(views if entry.offset_m[0] > 0.0 else views[::-1]):
                self.folder.put(f"{folder}/im{number}.png", view.png("rgb"))
                self.folder.put(f"{folder}/disp{number}.pfm", encode_pfm(disparity_of(view, entry)))
            self.folder.put(f"{folder}/calib.txt", calibration_of(views[0].row, entry).encode())
            self.count("folders", scene.split)
        return ""

    def describe(self) -> dict[str, Any]:
        """Folders by split, and the conventions."""
        return {
            "folders": self.counts("folders"),
            "not_exported": ["labels, targets; views that are not rectified"],
            "disparity": "pixels, of the stored depth z: f b / z, float32, inf where there is none; the right column is u - d",
            "pixels": "calib.txt has pixel centres on integers, and its baseline is in millimetres",
        }


def is_rectified(entry: More) -> bool:
    """Whether a named camera stands beside another along its x axis alone, turned alike, with the same sensor."""
    along_x = entry.offset_m[0] != 0.0 and entry.offset_m[1:] == (0.0, 0.0)
    alike = not any(entry.rotation_deg) and entry.sensor is None and entry.fov_deg is None
    return entry.beside is not None and along_x and alike


def disparity_of(view: View, entry: More) -> NDArray[np.float32]:
    """[H, W] pixels between the columns of a point in both views: f b / z of stored depth; inf where there is none."""
    depth, shift = view.depth(), view.camera.intrinsics.fx * abs(entry.offset_m[0]) * view.depth_units_per_m
    return np.where(depth > 0, shift / np.maximum(depth, 1), np.inf).astype(np.float32)


def encode_pfm(values: NDArray[np.float32]) -> bytes:
    """[H, W] as a portable float map: rows from below, little endian."""
    height, width = values.shape
    return f"Pf\n{width} {height}\n-1.0\n".encode() + values[::-1].astype("<f4").tobytes()


def calibration_of(view: Mapping[str, Any], entry: More) -> str:
    """The text of calib.txt, of two views with one sensor: the row of either."""
    matrix = f"[{view['fx']!r} 0 {view['cx_opencv']!r}; 0 {view['fy']!r} {view['cy_opencv']!r}; 0 0 1]"
    lines = {"cam0": matrix, "cam1": matrix, "doffs": 0, "baseline": 1000.0 * abs(entry.offset_m[0])}
    lines |= {"width": view["width"], "height": view["height"]}
    return "".join(f"{name}={value}\n" for name, value in lines.items())

"""The six manifest tables: one row a column, from which the Arrow schemas, docs/columns.md and `verso columns` follow.

To add a column: add its row here, and its value where the row of its table is made (workers/scene/rows.py and, for what
captures have, workers/capture/rows.py).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import pyarrow as pa

SCHEMA_VERSION = 1

TABLES: dict[str, str] = {
    "scenes": "One row for each scene that was made: its objects, their poses at rest, and how well they rest.",
    "views": "One row for each camera of a pair: pose, intrinsics, files, and what the view shows.",
    "objects": "One row for each object, and for the table, in each view.",
    "assets": "One row for each shape that a scene uses.",
    "failures": "One row for each scene that could not be made, and why.",
    "timings": "One row for each scene: where its time went. The only table that is no function of job and seed.",
}
"""What a row of each table is."""

SORT_KEYS: dict[str, tuple[str, ...]] = {
    "scenes": ("scene_id",),
    "views": ("pose_id", "role"),
    "objects": ("pose_id", "role", "region_id"),
    "assets": ("instance_id",),
    "failures": ("scene_id",),
    "timings": ("scene_id",),
}
"""The key of each table: unique, and the order of merged rows."""

DETERMINISTIC_TABLES = tuple(table for table in TABLES if table != "timings")
"""Tables that are a function of job and seed: their canonical rows are in the dataset digest."""

FRAMES = {
    "world": "metres, z up, floor at z = 0, the middle of the table top over the origin; in a capture the board's frame",
    "camera": "the camera's optical frame: x right, y down, z forward, metres",
    "object": "the object's own frame: metres, z up, origin at the middle of its bounding box",
    "image": "pixels, u to the right and v down, from the image's upper left corner",
    "source": "the frame of the file that the shape came from",
}

Of = Literal["both", "scenes", "captures"]


@dataclass(frozen=True)
class Column:
    """A column, or a field inside one."""

    path: str
    """`bodies[].contacts[].force`: `[]` stands for the items of a list."""
    type: str
    """`double[16]` is a list of exactly 16, `list of struct` one of any length."""
    meaning: str
    unit: str = ""
    """`1` is a pure number, `id` and `count` are whole; empty for words and flags."""
    frame: str = ""
    """A key of FRAMES, or two for a matrix that takes coordinates of the second to the first."""
    null: bool = False
    """Whether the value may be missing where the column applies."""
    of: Of = "both"
    """The kind of dataset that has it; it is null in the other."""

    @property
    def nullable(self) -> bool:
        """Whether the Arrow schema lets the value be missing."""
        return self.null or self.of != "both"


_CATEGORY = "What the object is: mug, can, ...; in `scenes` and `views` the first object."
_INSTANCE = "Which shape of its category it is: the key of `assets`; in `scenes` the first object."
_SOURCE = "Kind of source of the shape: procedural, shapenet, urdf, or of a capture."
_SCENE_ID = "The scene, or the capture; ids count from the job's first_scene."
_POSE_ID = "The view's pose: even of input, aligned and projected views, odd of mirror views."
_ROLE = "Which view of its pair: input, aligned (the depth camera), mirror, or projected."
_REGION = "The value of its pixels in segment images: 2 the table, 3 and up the objects."
_PATCH = "Share of the patch that shows its object; null where there is no patch."


def _rest(inside: str, of: Of = "both") -> tuple[Column, ...]:
    """Quality of rest: of one object, or of the worst of a scene."""
    rows = (
        ("penetration_mm", "mm", "Deepest overlap of the true meshes at rest."),
        ("hover_gap_mm", "mm", "Gap between the object and what carries it."),
        (
            "support_margin_mm",
            "mm",
            "How far the centre of mass lies inside the hull of the contacts, seen from above.",
        ),
        (
            "residual_speed_mm_s",
            "mm/s",
            "Drift of the farthest point in the simulation's last window, before correction.",
        ),
        ("recheck_move_mm", "mm", "Motion when it was let go again, until 0.2 mm; null where it was not."),
        ("recheck_turn_deg", "deg", "Turn when it was let go again; null where it was not."),
        ("equilibrium_residual", "1", "Share of its weight that the contact forces cannot balance."),
    )
    return tuple(
        Column(inside + name, "double", meaning, unit, null=name.startswith("recheck"), of=of)
        for name, unit, meaning in rows
    )


COLUMNS: dict[str, tuple[Column, ...]] = {
    "scenes": (
        Column("scene_id", "int64", _SCENE_ID, "id"),
        Column("category", "string", _CATEGORY),
        Column("instance_id", "string", _INSTANCE),
        Column("source", "string", _SOURCE),
        Column("table_id", "string", "The table's shape: the key of `assets`."),
        Column("object_scale", "double", "Factor from the source's coordinates to metres.", "1"),
        Column(
            "T_world_obj",
            "double[16]",
            "Pose of the first object at rest: takes object coordinates to world coordinates; 4 x 4, row by row.",
            "m",
            "world, object",
        ),
        Column(
            "T_world_table",
            "double[16]",
            "Pose of the table: takes table coordinates to world coordinates; 4 x 4, row by row.",
            "m",
            "world, object",
        ),
        Column("pose", "string", "How the objects started: upright, tumbled or placed.", of="scenes"),
        Column("redraws", "int64", "How often the start position was drawn again before one was valid.", "count"),
        Column("effects", "list of string", "Names of the effects that ran."),
        Column("skipped", "list of struct", "Effects that did not run."),
        Column("skipped[].effect", "string", "Name of the effect."),
        Column("skipped[].why", "string", "Why it was not needed."),
        *_rest("", of="scenes"),
        Column("settle_s", "double", "Simulated time until rest; the longest of all objects.", "s", of="scenes"),
        Column("raycast_checked", "bool", "Whether every view was checked against the ray caster."),
        Column("settings_digest", "string", "SHA-256 of the settings and sources that shape a scene."),
        Column("bodies", "list of struct", "Every object of the scene.", of="scenes"),
        Column("bodies[].region_id", "int64", _REGION, "id"),
        Column("bodies[].category", "string", _CATEGORY),
        Column("bodies[].instance_id", "string", _INSTANCE),
        Column("bodies[].source", "string", _SOURCE),
        Column("bodies[].object_scale", "double", "Factor from the source's coordinates to metres.", "1"),
        Column(
            "bodies[].T_world_obj",
            "double[16]",
            "Pose at rest: takes object coordinates to world coordinates; 4 x 4, row by row.",
            "m",
            "world, object",
        ),
        Column("bodies[].redraws", "int64", "How often its start position was drawn again.", "count"),
        *_rest("bodies[]."),
        Column("bodies[].mass_kg", "double", "Mass, from volume (or surface, where open) and density.", "kg"),
        Column("bodies[].com", "double[3]", "Centre of mass at rest.", "m", "world"),
        Column("bodies[].contacts", "list of struct", "Contacts that carry it; their forces balance the weight."),
        Column("bodies[].contacts[].with_region", "int64", "The region that it touches there.", "id"),
        Column("bodies[].contacts[].point", "double[3]", "Where it touches.", "m", "world"),
        Column("bodies[].contacts[].normal", "double[3]", "Unit normal towards the object.", "1", "world"),
        Column("bodies[].contacts[].force", "double[3]", "Force on the object.", "N", "world"),
        Column("capture", "struct", "Quality of the capture.", of="captures"),
        Column("capture.name", "string", "Name of its folder."),
        Column(
            "capture.estimate", "string", "Which estimate of the camera poses was taken: markers, article or joint."
        ),
        Column("capture.input_sha256", "string", "SHA-256 of its input files; null where it was simulated.", null=True),
        Column("capture.views", "int64", "Photographs that are used.", "count"),
        Column("capture.markers", "int64", "Markers that were found, over the used photographs.", "count"),
        Column(
            "capture.reprojection_before_px",
            "double",
            "Median distance of corners, estimate from markers alone.",
            "px",
            null=True,
        ),
        Column(
            "capture.reprojection_px", "double", "Median distance of corners, estimate that was taken.", "px", null=True
        ),
        Column(
            "capture.depth_mm",
            "double",
            "Median distance of board points, measured by depth, from the board's plane.",
            "mm",
            null=True,
        ),
        Column("capture.depth_offset_m", "double", "Constant error of depth that was found.", "m"),
        Column("capture.depth_scale", "double", "Factor of depth that was found.", "1"),
        Column("capture.print_scale", "double", "Size of the printed board over its nominal size.", "1"),
        Column(
            "capture.identified", "list of string", "Parameters of the depth correction that the capture determines."
        ),
        Column("capture.depth_corrected", "bool", "Whether stored depth is corrected by them."),
        Column("capture.undistorted", "bool", "Whether the lens' distortion was taken out of the images."),
        Column("capture.converged", "bool", "Whether the estimate converged."),
        Column("capture.iterations", "int64", "Steps of the estimate.", "count"),
        Column("capture.cloud_points", "int64", "Points of the merged cloud.", "count"),
        Column(
            "capture.measured_share",
            "double",
            "Median over the mirror views of the share that is measured and not filled.",
            "1",
            null=True,
        ),
        Column("capture.left_out", "list of struct", "Photographs that are not used."),
        Column("capture.left_out[].number", "int64", "Number in the photograph's name.", "id"),
        Column("capture.left_out[].status", "string", "Short word for why."),
        Column("capture.left_out[].why", "string", "Why, in words."),
        Column("capture.notes", "list of string", "What else is worth knowing of the capture."),
        Column(
            "capture.pose_mm",
            "double",
            "Median error of camera positions against truth; null where there is none.",
            "mm",
            null=True,
        ),
        Column("capture.pose_deg", "double", "Median error of camera directions against truth.", "deg", null=True),
        Column(
            "capture.cloud_median_mm", "double", "Median distance of the cloud from the true surface.", "mm", null=True
        ),
        Column("capture.cloud_p95_mm", "double", "95th percentile of that distance.", "mm", null=True),
        Column("capture.completeness", "double", "Share of the true surface that the cloud covers.", "1", null=True),
        Column(
            "capture.depth_median_mm",
            "double",
            "Median over the views of the error of the depth that the other views give.",
            "mm",
            null=True,
        ),
    ),
    "views": (
        Column("pose_id", "int64", _POSE_ID, "id"),
        Column("parent_id", "int64", "The pair: the pose id of its input view.", "id"),
        Column("role", "string", _ROLE),
        Column("scene_id", "int64", _SCENE_ID, "id"),
        Column("category", "string", _CATEGORY),
        Column(
            "T_world_cam",
            "double[16]",
            "Pose of the camera: takes camera coordinates to world coordinates; 4 x 4, row by row.",
            "m",
            "world, camera",
        ),
        Column("inclination_rad", "double", "Angle of the optical axis below the horizontal.", "rad", "world"),
        Column(
            "yaw_rad",
            "double",
            "Direction from the scene to the camera about the vertical axis, from the x axis.",
            "rad",
            "world",
        ),
        Column("width", "int64", "Columns of the image.", "px"),
        Column("height", "int64", "Rows of the image.", "px"),
        Column("fx", "double", "Focal length along u.", "px"),
        Column("fy", "double", "Focal length along v.", "px"),
        Column("cx", "double", "Principal point, where the centre of the first pixel is at 0.5.", "px", "image"),
        Column("cy", "double", "Principal point, where the centre of the first pixel is at 0.5.", "px", "image"),
        Column(
            "cx_opencv",
            "double",
            "Principal point, where the centre of the first pixel is at 0, as in OpenCV.",
            "px",
            "image",
        ),
        Column(
            "cy_opencv",
            "double",
            "Principal point, where the centre of the first pixel is at 0, as in OpenCV.",
            "px",
            "image",
        ),
        Column(
            "depth_units_per_m",
            "double",
            "Units of its depth images in a metre; depth is z along the optical axis.",
            "1/m",
        ),
        Column(
            "d_z_m",
            "double",
            "Distance of the input camera from the object's front along the axis: places the mirror camera.",
            "m",
        ),
        Column("files", "list of struct", "Its images and patches."),
        Column("files[].path", "string", "Path below the dataset's folder; in tars the member of that name."),
        Column("files[].bytes", "int64", "Size of the file.", "byte"),
        Column("files[].sha256", "string", "SHA-256 of the file."),
        Column("object_pixels", "int64", "Pixels of all objects; null in projected views.", "count", null=True),
        Column(
            "visible_fraction",
            "double",
            "Share that is seen of the first object's pixels, unoccluded and also outside the frame; null in projected views.",
            "1",
            null=True,
        ),
        Column(
            "mirror_agreement",
            "struct",
            "Input depth carried into the mirror view, against mirror depth; null below 50 pixels.",
            null=True,
        ),
        Column("mirror_agreement.median_mm", "double", "Median difference on the object.", "mm"),
        Column("mirror_agreement.share", "double", "Share of pixels within the job's bound.", "1"),
        Column(
            "projected_filled_share",
            "double",
            "Share of the mirror image that the projection fills; of projected views.",
            "1",
            null=True,
        ),
        Column(
            "projected_hidden_share",
            "double",
            "Share of the filled pixels that show what the mirror camera cannot see.",
            "1",
            null=True,
        ),
        Column("patch_object_fraction", "double", _PATCH, "1", null=True),
        Column("capture", "struct", "The photograph.", of="captures"),
        Column("capture.number", "int64", "Number in the photograph's name.", "id"),
        Column("capture.markers", "int64", "Markers that were found in it.", "count"),
        Column(
            "capture.reprojection_before_px",
            "double",
            "Median distance of its corners, estimate from markers alone.",
            "px",
            null=True,
        ),
        Column(
            "capture.reprojection_px",
            "double",
            "Median distance of its corners, estimate that was taken.",
            "px",
            null=True,
        ),
        Column(
            "capture.depth_mm",
            "double",
            "Median distance of board points in its depth from the board's plane.",
            "mm",
            null=True,
        ),
        Column(
            "capture.pose_mm",
            "double",
            "Error of its position against truth; null where there is none.",
            "mm",
            null=True,
        ),
        Column("capture.pose_deg", "double", "Error of its direction against truth.", "deg", null=True),
        Column(
            "capture.measured_share",
            "double",
            "Of mirror views: share that is measured and not filled.",
            "1",
            null=True,
        ),
        Column(
            "capture.depth_median_mm",
            "double",
            "Of input views: error of the depth that the other views give for it.",
            "mm",
            null=True,
        ),
        Column(
            "capture.sources",
            "list of int64",
            "Of mirror views: numbers of the photographs that it is made of.",
            "id",
            null=True,
        ),
    ),
    "objects": (
        Column("pose_id", "int64", _POSE_ID, "id"),
        Column("role", "string", _ROLE),
        Column("region_id", "int64", _REGION, "id"),
        Column("scene_id", "int64", _SCENE_ID, "id"),
        Column("category", "string", _CATEGORY),
        Column("instance_id", "string", _INSTANCE),
        Column(
            "u", "int64", "Column of the object's origin; -1 outside the image or behind the camera.", "px", "image"
        ),
        Column("v", "int64", "Row of the object's origin; -1 outside the image or behind the camera.", "px", "image"),
        Column(
            "T_cam_obj",
            "double[16]",
            "Pose: takes object coordinates to camera coordinates; 4 x 4, row by row.",
            "m",
            "camera, object",
        ),
        Column("bbox_xywh", "int64[4]", "Bounding box of its pixels: left, top, width, height.", "px", "image"),
        Column("pixels", "int64", "Pixels of it that are seen.", "count"),
        Column(
            "visible_fraction",
            "double",
            "Share that is seen of its own pixels, unoccluded and also outside the frame.",
            "1",
        ),
        Column("patch_object_fraction", "double", _PATCH, "1", null=True),
    ),
    "assets": (
        Column("instance_id", "string", _INSTANCE),
        Column("category", "string", "What the shape is: mug, can, ..., or table."),
        Column("source", "string", _SOURCE),
        Column("licence", "string", "Licence of the shape; `unknown` where nobody said."),
        Column("path", "string", "File within its source; null where the shape was generated.", null=True),
        Column("sha256", "string", "SHA-256 of the source file, or of the generated arrays."),
        Column("extents_m", "double[3]", "Size of the bounding box along the axes.", "m", "object"),
        Column("volume_m3", "double", "Volume; null where the mesh is open.", "m3", null=True),
        Column("watertight", "bool", "Whether the mesh bounds a volume."),
        Column(
            "T_source_to_object",
            "double[16]",
            "Takes scaled source coordinates to object coordinates; 4 x 4, row by row.",
            "m",
            "object, source",
        ),
        Column("scale", "double", "Factor from the source's coordinates to metres.", "1"),
        Column("split", "string", "train, val or test, by the instance's id: no shape is in two."),
        Column("notes", "list of string", "What was repaired or left out.", null=True),
    ),
    "failures": (
        Column("scene_id", "int64", _SCENE_ID, "id"),
        Column("category", "string", _CATEGORY),
        Column("stage", "string", "The step that refused: assets, plan, settle, views, check, ..."),
        Column("kind", "string", "intrinsic (of job and seed) or environmental (killed, time, memory)."),
        Column("reason", "string", "A short stable word."),
        Column("detail", "string", "A sentence, with the number that was measured."),
        Column("attempts", "int64", "How often it was tried.", "count"),
    ),
    "timings": (
        Column("scene_id", "int64", _SCENE_ID, "id"),
        Column("category", "string", _CATEGORY),
        Column("stages", "list of struct", "Time by stage."),
        Column("stages[].name", "string", "The stage."),
        Column("stages[].seconds", "double", "Time it took.", "s"),
        Column("effects", "list of struct", "Time by effect, of those that have one; part of the stages' time."),
        Column("effects[].name", "string", "The effect."),
        Column("effects[].seconds", "double", "Time it took.", "s"),
        Column("total_s", "double", "Sum over the stages.", "s"),
    ),
}
"""Every column of every table, in the order of the schema."""


_PLAIN = {"int64": pa.int64(), "double": pa.float64(), "string": pa.string(), "bool": pa.bool_()}
_ARRAY = re.compile(r"(\w+)\[(\d+)\]")


def _type_of(column: Column, columns: Sequence[Column]) -> pa.DataType:
    """The Arrow type of a column; that of a struct follows from the columns inside it."""
    if column.type == "struct":
        return pa.struct(_fields(columns, f"{column.path}."))
    if column.type == "list of struct":
        return pa.list_(pa.struct(_fields(columns, f"{column.path}[].")))
    if (array := _ARRAY.fullmatch(column.type)) is not None:
        return pa.list_(pa.field("item", _PLAIN[array[1]], nullable=False), int(array[2]))
    if (items := column.type.removeprefix("list of ")) != column.type:
        return pa.list_(_PLAIN[items])
    return _PLAIN[column.type]


def _fields(columns: Sequence[Column], inside: str = "") -> list[pa.Field]:
    """The fields whose paths begin with `inside` and go no deeper, in order."""
    return [
        pa.field(column.path.removeprefix(inside), _type_of(column, columns), column.nullable)
        for column in columns
        if column.path.startswith(inside) and "." not in column.path.removeprefix(inside)
    ]


SCHEMAS: dict[str, pa.Schema] = {
    table: pa.schema(
        _fields(columns), {b"verso_table": table.encode(), b"schema_version": str(SCHEMA_VERSION).encode()}
    )
    for table, columns in COLUMNS.items()
}
"""The Arrow schema of each table, of scenes and of captures alike."""

NOT_OF_CAPTURES = tuple(column.path for column in COLUMNS["scenes"] if column.of == "scenes")
"""Columns of `scenes` that a capture cannot have, since nothing was simulated to rest: null there."""

ALWAYS_OF_SCENES = tuple(column.path for column in COLUMNS["scenes"] if column.of == "scenes" and not column.null)
"""Those of them that every simulated scene has."""

SHAPE_FILE_COLUMNS = (pa.field("file_bytes", pa.int64()), pa.field("file_sha256", pa.string()))
"""More columns of `assets` in a range's own file: the size and the SHA-256 of the asset's shape, null where none is
stored. The merged table does not have them."""

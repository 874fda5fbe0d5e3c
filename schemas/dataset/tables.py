"""The six manifest tables: one row a column, from which the Arrow schemas, docs/columns.md and `verso columns` follow.

To add a column: add its row here, and its value where the row of its table is made (workers/scene/rows.py and, for what
captures have, workers/capture/rows.py).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

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
    "views": ("pose_id", "role", "number"),
    "objects": ("pose_id", "role", "number", "region_id"),
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

Of = Literal["both", "scenes", "rest", "captures", "targets", "more", "look", "friction"]


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
    """The kind of dataset that has it, null in others: `rest`, of scenes on a table; `more`, of jobs with `cameras.more`;
    `look`, of jobs with that; `friction`, of jobs with `physics.friction` by category. A table without any value of a column, or
    of a field of one kind inside one, has the digest of one without it."""

    @property
    def nullable(self) -> bool:
        """Whether the Arrow schema lets the value be missing."""
        return self.null or self.of != "both"


_SHARED = {
    "category": "What the object is: mug, can, ...; in `scenes` and `views` the first object.",
    "instance": "Which shape of its category it is: the key of `assets`; in `scenes` the first object.",
    "source": "Kind of source of the shape: procedural, library, or of a capture.",
    "scene_id": "The scene, or the capture; ids count from the job's first_scene.",
    "pose_id": "The view's pose: even of input, aligned and projected views, odd of mirror views.",
    "role": "Which view of its pair: input, aligned (the depth camera), mirror, or projected; or the name of a camera of "
    "`cameras.more`.",
    "number": "Number among the views of its role in the scene, from 0; null in the views that every pair has.",
    "region": "The value of its pixels in segment images: 2 the table, 3 and up the objects, 200 and up clutter.",
    "patch": "Share of the patch that shows its object; null where there is no patch.",
    "scale": "Factor from the source's coordinates to metres.",
    "overlap": "Deepest overlap of the true meshes at rest.",
    "gap": "Gap between the object and what carries it.",
    "margin": "How far the centre of mass lies inside the hull of the contacts, seen from above.",
    "drift": "Drift of the farthest point in the simulation's last window, before correction.",
    "move": "Motion when it was let go again, until 0.2 mm; null where it was not.",
    "turn": "Turn when it was let go again; null where it was not.",
    "balance": "Share of its weight that the contact forces cannot balance.",
    "centre": "Principal point, where the centre of the first pixel is at 0.5.",
    "centre_opencv": "Principal point, where the centre of the first pixel is at 0, as in OpenCV.",
    "share_seen": "unoccluded and also outside the frame",
    "markers": "Markers that are seen; in `scenes` in all used photographs.",
    "corners_before": "Median distance of corners, estimate from markers alone.",
    "corners": "Median distance of corners, estimate that was taken.",
    "board_depth": "Median distance of board points, measured by depth, from the board's plane.",
    "pose_mm": "Error of the camera's position against truth, in `scenes` the median; null where there is none.",
    "pose_deg": "Error of its direction against truth, likewise.",
    "measured": "Share of a mirror view that is measured and not filled; in `scenes` the median.",
    "depth_median": "Median error of the depth that other views give for a photograph; in `scenes` the median of all.",
}
"""Meanings, and parts of some, that several columns have: `{name}` in the table below."""

_ROWS = {
    "scenes": """
scene_id | int64 | id | - | {scene_id}
category | string | - | - | {category}
instance_id | string | - | - | {instance}
source | string | - | - | {source}
table_id | string? | - | - | The table's shape: the key of `assets`; null in a studio scene.
object_scale | double | 1 | - | {scale}
T_world_obj | double[16] | m | world, object | Pose of the first object at rest.
T_world_table | double[16]? | m | world, object | Pose of the table; null in a studio scene.
pose | string, scenes | - | - | How the objects started: upright, tumbled, placed or as_given.
redraws | int64 | count | - | How often the start position was drawn again before one was valid.
effects | list of string | - | - | Names of the effects that ran.
skipped | list of struct | - | - | Effects that did not run.
skipped[].effect | string | - | - | Name of the effect.
skipped[].why | string | - | - | Why it was not needed, and by which proof.
penetration_mm | double, rest | mm | - | {overlap}
hover_gap_mm | double, rest | mm | - | {gap}
support_margin_mm | double, rest | mm | - | {margin}
residual_speed_mm_s | double, rest | mm/s | - | {drift}
recheck_move_mm | double?, rest | mm | - | {move}
recheck_turn_deg | double?, rest | deg | - | {turn}
equilibrium_residual | double, rest | 1 | - | {balance}
settle_s | double, rest | s | - | Simulated time until rest; the longest of all objects.
raycast_checked | bool | - | - | Whether every view was checked against the ray caster.
settings_digest | string | - | - | SHA-256 of the settings and sources that shape a scene.
bodies | list of struct, scenes | - | - | Every object; above stand names and pose of the first, the worst figures of all.
bodies[].region_id | int64 | id | - | {region}
bodies[].category | string | - | - | {category}
bodies[].instance_id | string | - | - | {instance}
bodies[].source | string | - | - | {source}
bodies[].object_scale | double | 1 | - | {scale}
bodies[].T_world_obj | double[16] | m | world, object | Pose at rest.
bodies[].redraws | int64 | count | - | How often its start position was drawn again.
bodies[].penetration_mm | double? | mm | - | {overlap}
bodies[].hover_gap_mm | double? | mm | - | {gap}
bodies[].support_margin_mm | double? | mm | - | {margin}
bodies[].residual_speed_mm_s | double? | mm/s | - | {drift}
bodies[].recheck_move_mm | double? | mm | - | {move}
bodies[].recheck_turn_deg | double? | deg | - | {turn}
bodies[].equilibrium_residual | double? | 1 | - | {balance}
bodies[].mass_kg | double | kg | - | Mass, from volume (or surface, where open) and density.
bodies[].friction | double, friction | 1 | - | Coefficient of its surface; a contact's is the product of two, at most 10.
bodies[].com | double[3] | m | world | Centre of mass at rest.
bodies[].contacts | list of struct | - | - | Contacts that carry it; their forces balance the weight.
bodies[].contacts[].with_region | int64 | id | - | The region that it touches there.
bodies[].contacts[].point | double[3] | m | world | Where it touches.
bodies[].contacts[].normal | double[3] | 1 | world | Unit normal towards the object.
bodies[].contacts[].force | double[3] | N | world | Force on the object.
surroundings | struct, look | - | - | What was drawn of the surroundings in `look`; null fields are as built in.
surroundings.floor | string? | - | - | Picture of the floor, below its folder, or sRGB colour.
surroundings.floor_tile_m | double? | m | - | Width of that picture on the floor.
surroundings.table | string? | - | - | Picture of the table, below its folder, or sRGB colour.
surroundings.table_tile_m | double? | m | - | Width of that picture on the table.
surroundings.background | string? | - | - | Picture behind everything, below its folder.
surroundings.room_m | list of double? | m | world | Length along x, width along y, and height of the room inside.
surroundings.lights | list of struct? | - | - | Lights of `look.lights`; the first casts shadows.
surroundings.lights[].towards | list of double | 1 | world | Unit vector towards it.
surroundings.lights[].level | double | 1 | - | Light that it gives to a level white surface, of which 1 is white.
surroundings.lights[].temperature_k | double | K | - | Its colour temperature.
surroundings.lights[].size_deg | double | deg | - | Angle across it.
surroundings.environment | string? | - | - | Map of `look.environment`: name of its file, or of a built-in sky or room.
surroundings.environment_deg | double? | deg | - | Its turn about the vertical, counter-clockwise from above.
surroundings.clutter | list of struct? | - | - | Objects that have no other row, in images, masks and depth alone.
surroundings.clutter[].region_id | int64 | id | - | {region}
surroundings.clutter[].category | string | - | - | {category}
surroundings.clutter[].instance_id | string | - | - | {instance}
surroundings.clutter[].T_world_obj | double[16] | m | world, object | Pose at rest.
capture | struct, captures | - | - | Quality of the capture.
capture.name | string | - | - | Name of its folder.
capture.estimate | string | - | - | Which estimate of the camera poses was taken: markers, article or joint.
capture.input_sha256 | string? | - | - | SHA-256 of its input files; null where it was simulated.
capture.views | int64 | count | - | Photographs that are used.
capture.markers | int64 | count | - | {markers}
capture.reprojection_before_px | double? | px | - | {corners_before}
capture.reprojection_px | double? | px | - | {corners}
capture.depth_mm | double? | mm | - | {board_depth}
capture.depth_offset_m | double | m | - | Constant error of depth that was found.
capture.depth_scale | double | 1 | - | Factor of depth that was found.
capture.print_scale | double | 1 | - | Size of the printed board over its nominal size.
capture.identified | list of string | - | - | Parameters of the depth correction that the capture determines.
capture.depth_corrected | bool | - | - | Whether stored depth is corrected by them.
capture.undistorted | bool | - | - | Whether the lens' distortion was taken out of the images.
capture.converged | bool | - | - | Whether the estimate converged.
capture.iterations | int64 | count | - | Steps of the estimate.
capture.cloud_points | int64 | count | - | Points of the merged cloud.
capture.measured_share | double? | 1 | - | {measured}
capture.left_out | list of struct | - | - | Photographs that are not used.
capture.left_out[].number | int64 | id | - | Number in the photograph's name.
capture.left_out[].status | string | - | - | Short word for why.
capture.left_out[].why | string | - | - | Why, in words.
capture.notes | list of string | - | - | What else is worth knowing of the capture.
capture.pose_mm | double? | mm | - | {pose_mm}
capture.pose_deg | double? | deg | - | {pose_deg}
capture.cloud_median_mm | double? | mm | - | Median distance of the cloud from the true surface.
capture.cloud_p95_mm | double? | mm | - | 95th percentile of that distance.
capture.completeness | double? | 1 | - | Share of the true surface that the cloud covers.
capture.depth_median_mm | double? | mm | - | {depth_median}
""",
    "views": """
pose_id | int64 | id | - | {pose_id}
parent_id | int64 | id | - | The pair: the pose id of its input view.
role | string | - | - | {role}
number | int64?, more | id | - | {number}
scene_id | int64 | id | - | {scene_id}
category | string | - | - | {category}
T_world_cam | double[16] | m | world, camera | Pose of the camera.
inclination_rad | double | rad | world | Angle of the optical axis below the horizontal.
yaw_rad | double | rad | world | Direction from the scene to the camera about the vertical axis, from the x axis.
width | int64 | px | - | Columns of the image.
height | int64 | px | - | Rows of the image.
fx | double | px | - | Focal length along u.
fy | double | px | - | Focal length along v.
cx | double | px | image | {centre}
cy | double | px | image | {centre}
cx_opencv | double | px | image | {centre_opencv}
cy_opencv | double | px | image | {centre_opencv}
depth_units_per_m | double | 1/m | - | Units of its depth images in a metre; depth is z along the optical axis.
d_z_m | double | m | - | Distance of the input camera from the object's front along the axis: places the mirror camera.
files | list of struct | - | - | Its images and patches.
files[].path | string | - | - | Path below the dataset's folder; in tars the member of that name.
files[].bytes | int64 | byte | - | Size of the file.
files[].sha256 | string | - | - | SHA-256 of the file.
object_pixels | int64? | count | - | Pixels of all objects; null in projected views.
visible_fraction | double? | 1 | - | Share that is seen of the first object's pixels, {share_seen}; null in projected views.
mirror_agreement | struct? | - | - | Input depth carried into the mirror view, against mirror depth; null below 50 pixels.
mirror_agreement.median_mm | double | mm | - | Median difference on the object.
mirror_agreement.share | double | 1 | - | Share of pixels within the job's bound.
projected_filled_share | double? | 1 | - | Share of the mirror image that the projection fills; of projected views.
projected_hidden_share | double? | 1 | - | Share of the filled pixels that show what the mirror camera cannot see.
patch_object_fraction | double? | 1 | - | {patch}
capture | struct, captures | - | - | The photograph.
capture.number | int64 | id | - | Number in the photograph's name.
capture.markers | int64 | count | - | {markers}
capture.reprojection_before_px | double? | px | - | {corners_before}
capture.reprojection_px | double? | px | - | {corners}
capture.depth_mm | double? | mm | - | {board_depth}
capture.pose_mm | double? | mm | - | {pose_mm}
capture.pose_deg | double? | deg | - | {pose_deg}
capture.measured_share | double? | 1 | - | {measured}
capture.depth_median_mm | double? | mm | - | {depth_median}
capture.sources | list of int64? | id | - | Of mirror views: numbers of the photographs that it is made of.
""",
    "objects": """
pose_id | int64 | id | - | {pose_id}
role | string | - | - | {role}
number | int64?, more | id | - | {number}
region_id | int64 | id | - | {region}
scene_id | int64 | id | - | {scene_id}
category | string | - | - | {category}
instance_id | string | - | - | {instance}
u | int64 | px | image | Column of the object's origin; -1 outside the image or behind the camera.
v | int64 | px | image | Row of the object's origin; -1 outside the image or behind the camera.
T_cam_obj | double[16] | m | camera, object | Pose.
bbox_xywh | int64[4] | px | image | Bounding box of its pixels: left, top, width, height.
pixels | int64 | count | - | Pixels of it that are seen.
visible_fraction | double | 1 | - | Share that is seen of its own pixels, {share_seen}.
patch_object_fraction | double? | 1 | - | {patch}
amodal_bbox_xywh | int64[4]?, targets | px | image | Bounding box of its image `amodal`; null without the target.
amodal_pixels | int64?, targets | count | - | Pixels of its image `amodal`: in the image, hidden ones too.
coordinates_scale_m | double?, targets | m | - | Its `coordinates`: scale * value / 65535 + offset is a point of it.
coordinates_offset_m | double[3]?, targets | m | object | That offset.
targets_share | double?, targets | 1 | - | Of captures: share of its pixels that have `normals` and `coordinates`.
""",
    "assets": """
instance_id | string | - | - | {instance}
category | string | - | - | What the shape is: mug, can, ..., or table.
source | string | - | - | {source}
licence | string | - | - | Licence of the shape; `unknown` where nobody said.
path | string? | - | - | File within its source; null where the shape was generated.
sha256 | string | - | - | SHA-256 of the source file, or of the generated arrays.
extents_m | double[3] | m | object | Size of the bounding box along the axes.
volume_m3 | double? | m3 | - | Volume; null where the mesh is open.
watertight | bool | - | - | Whether the mesh bounds a volume.
T_source_to_object | double[16] | m | object, source | Takes scaled source coordinates to object coordinates.
scale | double | 1 | - | {scale}
split | string | - | - | train, val, test, unseen or none, by the instance's id: no shape is in two.
notes | list of string? | - | - | What was repaired or left out.
samples | struct?, targets | - | - | An object's points (`targets.shape`); null without, and where `notes` says why.
samples.path | string | - | - | Path below the dataset's folder.
samples.bytes | int64 | byte | - | Size of the file.
samples.sha256 | string | - | - | SHA-256 of the file.
samples.points | int64 | count | - | Number of points of the surface, and as many of the volume.
samples.open_share | double? | 1 | - | Share of the volume's points of which the faces leave open whether they are inside.
""",
    "failures": """
scene_id | int64 | id | - | {scene_id}
category | string | - | - | {category}
stage | string | - | - | The step that refused: assets, plan, settle, views, check, ...
kind | string | - | - | intrinsic (of job and seed) or environmental (killed, time, memory).
reason | string | - | - | A short stable word.
detail | string | - | - | A sentence, with the number that was measured.
attempts | int64 | count | - | How often it was tried.
""",
    "timings": """
scene_id | int64 | id | - | {scene_id}
category | string | - | - | {category}
stages | list of struct | - | - | Time by stage.
stages[].name | string | - | - | The stage.
stages[].seconds | double | s | - | Time it took.
effects | list of struct | - | - | Time by effect, of those that have one; part of the stages' time.
effects[].name | string | - | - | The effect.
effects[].seconds | double | s | - | Time it took.
total_s | double | s | - | Sum over the stages.
""",
}
"""A line is a column: path | type, with a ? where it may be missing, and the kind of dataset if only one has it | unit |
frame | meaning."""


def _read(line: str) -> Column:
    """The column of a line of `_ROWS`."""
    path, kind, unit, frame, meaning = line.split(" | ")
    type_, _, of = kind.partition(", ")
    unit, frame = ("" if word == "-" else word for word in (unit, frame))
    null = type_.endswith("?")
    return Column(path, type_.rstrip("?"), meaning.format_map(_SHARED), unit, frame, null, of or "both")  # type: ignore[arg-type]


COLUMNS: dict[str, tuple[Column, ...]] = {
    table: tuple(_read(line) for line in text.strip().splitlines()) for table, text in _ROWS.items()
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

NOT_OF_CAPTURES = tuple(column.path for column in COLUMNS["scenes"] if column.of in ("scenes", "rest"))
"""Columns of `scenes` that a capture cannot have, since nothing was simulated to rest: null there."""

ALWAYS_OF: dict[str, tuple[str, ...]] = {
    kind: tuple(column.path for column in COLUMNS["scenes"] if column.of == kind and not column.null)
    for kind in ("scenes", "rest")
}
"""Those of them that every simulated scene has, and that every scene on a table has."""


def misplaced_columns(scene: Mapping[str, Any]) -> str:
    """Columns that a row of `scenes` lacks, or that a capture, or a scene without a table, has; empty where none is wrong."""
    captured, alone = scene["capture"] is not None, scene["table_id"] is None
    for kind, absent, place in (
        ("scenes", captured, "a capture"),
        ("rest", captured or alone, "a scene without a table"),
    ):
        if wrong := [name for name in ALWAYS_OF[kind] if (scene[name] is None) != absent]:
            return f"{', '.join(wrong)}: {f'there in {place}' if absent else 'missing'}"
    return ""


OF_TARGETS = {
    table: frozenset(column.path for column in columns if column.of == "targets") for table, columns in COLUMNS.items()
}
"""Columns of image targets and of samples of shapes, null in jobs without them."""

OF_SOME = {
    table: frozenset(column.path for column in columns if column.of != "both") for table, columns in COLUMNS.items()
}
"""Columns that datasets of one kind alone have."""

SHAPE_FILE_COLUMNS = (pa.field("file_bytes", pa.int64()), pa.field("file_sha256", pa.string()))
"""More columns of `assets` in a range's own file: the size and the SHA-256 of the asset's GLB, null where none is
stored. The merged table does not have them. Its samples are in the column `samples`."""

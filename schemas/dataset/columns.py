"""What every column of the manifest tables means: unit, frame and meaning, beside the schemas of `tables.py`."""

from collections.abc import Iterator
from dataclasses import dataclass
from types import MappingProxyType

import pyarrow as pa

from schemas.dataset.tables import CAPTURE_SCHEMAS, SCHEMAS, SORT_KEYS

TABLE_MEANINGS = {
    "scenes": "One row for each scene that was made: its objects, their poses at rest, and how well they rest.",
    "views": "One row for each camera of a pair: pose, intrinsics, files, and what the view shows.",
    "objects": "One row for each object, and for the table, in each view.",
    "assets": "One row for each shape that a scene uses.",
    "failures": "One row for each scene that could not be made, and why.",
    "timings": "One row for each scene: where its time went. The only table that is no function of job and seed.",
}

FRAMES = {
    "world": "metres, z up, floor at z = 0, the middle of the table top over the origin; in a capture the board's frame",
    "camera": "the camera's optical frame: x right, y down, z forward, metres",
    "object": "the object's own frame: metres, z up, origin at the middle of its bounding box",
    "image": "pixels, u to the right and v down, from the image's upper left corner",
    "source": "the frame of the file that the shape came from",
}


@dataclass(frozen=True)
class Meaning:
    """The meaning of a column. `unit`: `1` is a pure number, `id` and `count` are whole; empty for words and flags.

    `frame`: a key of FRAMES, or two for a matrix that takes coordinates of the second to the first.
    """

    text: str
    unit: str = ""
    frame: str = ""


@dataclass(frozen=True)
class Column:
    """A column, or a field inside one, as the page and `verso columns` show it."""

    table: str
    path: str
    """`bodies[].contacts[].force`: `[]` stands for the items of a list."""
    type: str
    nullable: bool
    captures_only: bool
    meaning: Meaning


_T = "takes {} coordinates to {} coordinates; 4 x 4, row by row"

_EVERYWHERE = {
    "scene_id": Meaning("The scene, or the capture; ids count from the job's first_scene.", "id"),
    "category": Meaning("What the object is: mug, can, ...; in `scenes` and `views` the first object."),
    "instance_id": Meaning("Which shape of its category it is: the key of `assets`; in `scenes` the first object."),
    "pose_id": Meaning("The view's pose: even of input, aligned and projected views, odd of mirror views.", "id"),
    "role": Meaning("Which view of its pair: input, aligned (the depth camera), mirror, or projected."),
    "region_id": Meaning("The value of its pixels in segment images: 2 the table, 3 and up the objects.", "id"),
    "source": Meaning("Kind of source of the shape: procedural, shapenet, urdf, or of a capture."),
    "patch_object_fraction": Meaning("Share of the patch that shows its object; null where there is no patch.", "1"),
}

_REST = {
    "penetration_mm": Meaning("Deepest overlap of the true meshes at rest.", "mm"),
    "hover_gap_mm": Meaning("Gap between the object and what carries it.", "mm"),
    "support_margin_mm": Meaning(
        "How far the centre of mass lies inside the hull of the contacts, seen from above.", "mm"
    ),
    "residual_speed_mm_s": Meaning(
        "Drift of the farthest point in the simulation's last window, before correction.", "mm/s"
    ),
    "recheck_move_mm": Meaning("Motion when it was let go again, until 0.2 mm; null where it was not.", "mm"),
    "recheck_turn_deg": Meaning("Turn when it was let go again; null where it was not.", "deg"),
    "equilibrium_residual": Meaning("Share of its weight that the contact forces cannot balance.", "1"),
}

_SCENES = {
    "table_id": Meaning("The table's shape: the key of `assets`."),
    "object_scale": Meaning("Factor from the source's coordinates to metres.", "1"),
    "T_world_obj": Meaning(f"Pose of the first object at rest: {_T.format('object', 'world')}.", "m", "world, object"),
    "T_world_table": Meaning(f"Pose of the table: {_T.format('table', 'world')}.", "m", "world, object"),
    "pose": Meaning("How the objects started: upright, tumbled or placed."),
    "redraws": Meaning("How often the start position was drawn again before one was valid.", "count"),
    "effects": Meaning("Names of the effects that ran."),
    "skipped": Meaning("Effects that did not run."),
    "skipped[].effect": Meaning("Name of the effect."),
    "skipped[].why": Meaning("Why it was not needed."),
    "settle_s": Meaning("Simulated time until rest; the longest of all objects.", "s"),
    "raycast_checked": Meaning("Whether every view was checked against the ray caster."),
    "settings_digest": Meaning("SHA-256 of the settings and sources that shape a scene."),
    "bodies": Meaning("Every object of the scene; null in captures, and in scenes of the first version."),
    "bodies[].object_scale": Meaning("Factor from the source's coordinates to metres.", "1"),
    "bodies[].T_world_obj": Meaning(f"Pose at rest: {_T.format('object', 'world')}.", "m", "world, object"),
    "bodies[].redraws": Meaning("How often its start position was drawn again.", "count"),
    "bodies[].mass_kg": Meaning("Mass, from volume (or surface, where open) and density.", "kg"),
    "bodies[].com": Meaning("Centre of mass at rest.", "m", "world"),
    "bodies[].contacts": Meaning("Contacts that carry it; their forces balance the weight."),
    "bodies[].contacts[].with_region": Meaning("The region that it touches there.", "id"),
    "bodies[].contacts[].point": Meaning("Where it touches.", "m", "world"),
    "bodies[].contacts[].normal": Meaning("Unit normal towards the object.", "1", "world"),
    "bodies[].contacts[].force": Meaning("Force on the object.", "N", "world"),
    "capture": Meaning("Quality of the capture; null in datasets of scenes."),
    "capture.name": Meaning("Name of its folder."),
    "capture.estimate": Meaning("Which estimate of the camera poses was taken: markers, article or joint."),
    "capture.input_sha256": Meaning("SHA-256 of its input files; null where it was simulated."),
    "capture.views": Meaning("Photographs that are used.", "count"),
    "capture.markers": Meaning("Markers that were found, over the used photographs.", "count"),
    "capture.reprojection_before_px": Meaning("Median distance of corners, estimate from markers alone.", "px"),
    "capture.reprojection_px": Meaning("Median distance of corners, estimate that was taken.", "px"),
    "capture.depth_mm": Meaning("Median distance of board points, measured by depth, from the board's plane.", "mm"),
    "capture.depth_offset_m": Meaning("Constant error of depth that was found.", "m"),
    "capture.depth_scale": Meaning("Factor of depth that was found.", "1"),
    "capture.print_scale": Meaning("Size of the printed board over its nominal size.", "1"),
    "capture.identified": Meaning("Parameters of the depth correction that the capture determines."),
    "capture.depth_corrected": Meaning("Whether stored depth is corrected by them."),
    "capture.undistorted": Meaning("Whether the lens' distortion was taken out of the images."),
    "capture.converged": Meaning("Whether the estimate converged."),
    "capture.iterations": Meaning("Steps of the estimate.", "count"),
    "capture.cloud_points": Meaning("Points of the merged cloud.", "count"),
    "capture.measured_share": Meaning(
        "Median over the mirror views of the share that is measured and not filled.", "1"
    ),
    "capture.left_out": Meaning("Photographs that are not used."),
    "capture.left_out[].number": Meaning("Number in the photograph's name.", "id"),
    "capture.left_out[].status": Meaning("Short word for why."),
    "capture.left_out[].why": Meaning("Why, in words."),
    "capture.notes": Meaning("What else is worth knowing of the capture."),
    "capture.pose_mm": Meaning("Median error of camera positions against truth; null where there is none.", "mm"),
    "capture.pose_deg": Meaning("Median error of camera directions against truth.", "deg"),
    "capture.cloud_median_mm": Meaning("Median distance of the cloud from the true surface.", "mm"),
    "capture.cloud_p95_mm": Meaning("95th percentile of that distance.", "mm"),
    "capture.completeness": Meaning("Share of the true surface that the cloud covers.", "1"),
    "capture.depth_median_mm": Meaning(
        "Median over the views of the error of the depth that the other views give.", "mm"
    ),
}

_VIEWS = {
    "parent_id": Meaning("The pair: the pose id of its input view.", "id"),
    "T_world_cam": Meaning(f"Pose of the camera: {_T.format('camera', 'world')}.", "m", "world, camera"),
    "inclination_rad": Meaning("Angle of the optical axis below the horizontal.", "rad", "world"),
    "yaw_rad": Meaning(
        "Direction from the scene to the camera about the vertical axis, from the x axis.", "rad", "world"
    ),
    "width": Meaning("Columns of the image.", "px"),
    "height": Meaning("Rows of the image.", "px"),
    "fx": Meaning("Focal length along u.", "px"),
    "fy": Meaning("Focal length along v.", "px"),
    "cx": Meaning("Principal point, where the centre of the first pixel is at 0.5.", "px", "image"),
    "cy": Meaning("Principal point, where the centre of the first pixel is at 0.5.", "px", "image"),
    "cx_opencv": Meaning("Principal point, where the centre of the first pixel is at 0, as in OpenCV.", "px", "image"),
    "cy_opencv": Meaning("Principal point, where the centre of the first pixel is at 0, as in OpenCV.", "px", "image"),
    "depth_units_per_m": Meaning("Units of its depth images in a metre; depth is z along the optical axis.", "1/m"),
    "d_z_m": Meaning(
        "Distance of the input camera from the object's front along the axis: places the mirror camera.", "m"
    ),
    "files": Meaning("Its images and patches."),
    "files[].path": Meaning("Path below the dataset's folder; in tars the member of that name."),
    "files[].bytes": Meaning("Size of the file.", "byte"),
    "files[].sha256": Meaning("SHA-256 of the file."),
    "object_pixels": Meaning("Pixels of all objects; null in projected views.", "count"),
    "visible_fraction": Meaning(
        "Share that is seen of the first object's pixels, unoccluded and also outside the frame; null in projected views.",
        "1",
    ),
    "mirror_agreement": Meaning(
        "Input depth carried into the mirror view, against mirror depth; null below 50 pixels."
    ),
    "mirror_agreement.median_mm": Meaning("Median difference on the object.", "mm"),
    "mirror_agreement.share": Meaning("Share of pixels within the job's bound.", "1"),
    "projected_filled_share": Meaning("Share of the mirror image that the projection fills; of projected views.", "1"),
    "projected_hidden_share": Meaning("Share of the filled pixels that show what the mirror camera cannot see.", "1"),
    "capture": Meaning("The photograph; null in datasets of scenes."),
    "capture.number": Meaning("Number in the photograph's name.", "id"),
    "capture.markers": Meaning("Markers that were found in it.", "count"),
    "capture.reprojection_before_px": Meaning("Median distance of its corners, estimate from markers alone.", "px"),
    "capture.reprojection_px": Meaning("Median distance of its corners, estimate that was taken.", "px"),
    "capture.depth_mm": Meaning("Median distance of board points in its depth from the board's plane.", "mm"),
    "capture.pose_mm": Meaning("Error of its position against truth; null where there is none.", "mm"),
    "capture.pose_deg": Meaning("Error of its direction against truth.", "deg"),
    "capture.measured_share": Meaning("Of mirror views: share that is measured and not filled.", "1"),
    "capture.depth_median_mm": Meaning("Of input views: error of the depth that the other views give for it.", "mm"),
    "capture.sources": Meaning("Of mirror views: numbers of the photographs that it is made of.", "id"),
}

_OBJECTS = {
    "u": Meaning("Column of the object's origin; -1 outside the image or behind the camera.", "px", "image"),
    "v": Meaning("Row of the object's origin; -1 outside the image or behind the camera.", "px", "image"),
    "T_cam_obj": Meaning(f"Pose: {_T.format('object', 'camera')}.", "m", "camera, object"),
    "bbox_xywh": Meaning("Bounding box of its pixels: left, top, width, height.", "px", "image"),
    "pixels": Meaning("Pixels of it that are seen.", "count"),
    "visible_fraction": Meaning("Share that is seen of its own pixels, unoccluded and also outside the frame.", "1"),
}

_ASSETS = {
    "category": Meaning("What the shape is: mug, can, ..., or table."),
    "licence": Meaning("Licence of the shape; `unknown` where nobody said."),
    "path": Meaning("File within its source; null where the shape was generated."),
    "sha256": Meaning("SHA-256 of the source file, or of the generated arrays."),
    "extents_m": Meaning("Size of the bounding box along the axes.", "m", "object"),
    "volume_m3": Meaning("Volume; null where the mesh is open.", "m3"),
    "watertight": Meaning("Whether the mesh bounds a volume."),
    "T_source_to_object": Meaning(f"{_T.format('scaled source', 'object').capitalize()}.", "m", "object, source"),
    "scale": Meaning("Factor from the source's coordinates to metres.", "1"),
    "split": Meaning("train, val or test, by the instance's id: no shape is in two."),
    "notes": Meaning("What was repaired or left out."),
}

_FAILURES = {
    "stage": Meaning("The step that refused: assets, plan, settle, views, check, ..."),
    "kind": Meaning("intrinsic (of job and seed) or environmental (killed, time, memory)."),
    "reason": Meaning("A short stable word."),
    "detail": Meaning("A sentence, with the number that was measured."),
    "attempts": Meaning("How often it was tried.", "count"),
}

_TIMINGS = {
    "stages": Meaning("Time by stage."),
    "stages[].name": Meaning("The stage."),
    "stages[].seconds": Meaning("Time it took.", "s"),
    "effects": Meaning("Time by effect, of those that have one; part of the stages' time."),
    "effects[].name": Meaning("The effect."),
    "effects[].seconds": Meaning("Time it took.", "s"),
    "total_s": Meaning("Sum over the stages.", "s"),
}

MEANINGS = MappingProxyType(
    {
        "scenes": {**_REST, **{f"bodies[].{name}": one for name, one in _REST.items()}, **_SCENES},
        "views": _VIEWS,
        "objects": _OBJECTS,
        "assets": _ASSETS,
        "failures": _FAILURES,
        "timings": _TIMINGS,
    }
)
"""By table and path; a column that several tables have alike stands in `EVERYWHERE` by its name."""

EVERYWHERE = MappingProxyType(_EVERYWHERE)


def columns_of(table: str) -> list[Column]:
    """Every column of a table and every field inside one, in the order of the schema. Raises KeyError without a meaning."""
    own = SCHEMAS[table]
    columns = []
    for field in CAPTURE_SCHEMAS[table]:
        of_captures = field.name not in own.names
        nullable = field.nullable if of_captures else own.field(field.name).nullable
        for path, kind, null in _walk(field.name, field.type, nullable):
            columns.append(Column(table, path, type_name(kind), null, of_captures, meaning_of(table, path)))
    return columns


def key_of(table: str) -> tuple[str, ...]:
    """The columns that tell a table's rows apart."""
    return SORT_KEYS[table]


def meaning_of(table: str, path: str) -> Meaning:
    """The meaning of a column or a field. Raises KeyError where it has none."""
    return MEANINGS[table].get(path) or EVERYWHERE[path.rpartition(".")[2]]


def type_name(kind: pa.DataType) -> str:
    """A type in a word or two: `double[16]` is a list of exactly 16, `list of struct` one of any length."""
    if pa.types.is_fixed_size_list(kind):
        return f"{type_name(kind.value_type)}[{kind.list_size}]"
    if pa.types.is_list(kind):
        return f"list of {type_name(kind.value_type)}"
    return "struct" if pa.types.is_struct(kind) else str(kind)


def _walk(path: str, kind: pa.DataType, nullable: bool) -> Iterator[tuple[str, pa.DataType, bool]]:
    """(path, type, nullable) of a field and of every field inside."""
    yield path, kind, nullable
    if pa.types.is_list(kind) and pa.types.is_struct(kind.value_type):
        path, kind = f"{path}[]", kind.value_type
    if pa.types.is_struct(kind):
        for field in kind:
            yield from _walk(f"{path}.{field.name}", field.type, field.nullable)

"""The Arrow schemas and the keys of the six manifest tables."""

from collections.abc import Collection

import pyarrow as pa

SCHEMA_VERSION = 1

TABLES = ("scenes", "views", "objects", "assets", "failures", "timings")
DETERMINISTIC_TABLES = ("scenes", "views", "objects", "assets", "failures")
"""Tables that are a function of job and seed: their canonical rows are in the dataset digest."""

_i64, _f64, _str, _bool = pa.int64(), pa.float64(), pa.string(), pa.bool_()


def _columns(kind: pa.DataType, *names: str, nullable: bool = False) -> list[pa.Field]:
    return [pa.field(name, kind, nullable) for name in names]


def _array(kind: pa.DataType, length: int) -> pa.DataType:
    return pa.list_(pa.field("item", kind, nullable=False), length)


_matrix = _array(_f64, 16)
"""Row-major 4 x 4."""
_file = pa.struct([*_columns(_str, "path"), *_columns(_i64, "bytes"), *_columns(_str, "sha256")])
_skip = pa.struct(_columns(_str, "effect", "why"))
_rest = [
    *_columns(_f64, "penetration_mm", "hover_gap_mm", "support_margin_mm", "residual_speed_mm_s"),
    *_columns(_f64, "recheck_move_mm", "recheck_turn_deg", nullable=True),
    *_columns(_f64, "equilibrium_residual"),
]
"""Quality of rest: of one object, or of the worst of a scene."""
_contact = pa.struct([*_columns(_i64, "with_region"), *_columns(_array(_f64, 3), "point", "normal", "force")])
"""Contact of a body at rest: with which region, where, unit normal towards the body and force on it, newtons; world."""
_body = pa.struct(
    [
        *_columns(_i64, "region_id"),
        *_columns(_str, "category", "instance_id", "source"),
        *_columns(_f64, "object_scale"),
        *_columns(_matrix, "T_world_obj"),
        *_columns(_i64, "redraws"),
        *_rest,
        *_columns(_f64, "mass_kg"),
        *_columns(_array(_f64, 3), "com"),
        *_columns(pa.list_(_contact), "contacts"),
    ]
)
"""One object of a scene; the columns of `scenes` itself follow from these (codec.columns_of_bodies).

`com`: its centre of mass at rest, metres, world. Contact forces balance the weight to within `equilibrium_residual`.
"""
_agreement = pa.struct(_columns(_f64, "median_mm", "share"))
"""Input depth carried into the mirror view, compared with mirror depth: median difference, share within the bound."""
_seconds = pa.list_(pa.struct([*_columns(_str, "name"), *_columns(_f64, "seconds")]))

_COLUMNS: dict[str, list[pa.Field]] = {
    "scenes": [
        *_columns(_i64, "scene_id"),
        *_columns(_str, "category", "instance_id", "source", "table_id"),
        *_columns(_f64, "object_scale"),
        *_columns(_matrix, "T_world_obj", "T_world_table"),
        *_columns(_str, "pose"),
        *_columns(_i64, "redraws"),
        *_columns(pa.list_(_str), "effects"),
        *_columns(pa.list_(_skip), "skipped"),
        *_rest,
        *_columns(_f64, "settle_s"),
        *_columns(_bool, "raycast_checked"),
        *_columns(_str, "settings_digest"),
        *_columns(pa.list_(_body), "bodies", nullable=True),
    ],
    "views": [
        *_columns(_i64, "pose_id", "parent_id"),
        *_columns(_str, "role"),
        *_columns(_i64, "scene_id"),
        *_columns(_str, "category"),
        *_columns(_matrix, "T_world_cam"),
        *_columns(_f64, "inclination_rad", "yaw_rad"),
        *_columns(_i64, "width", "height"),
        *_columns(_f64, "fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv", "depth_units_per_m", "d_z_m"),
        *_columns(pa.list_(_file), "files"),
        *_columns(_i64, "object_pixels", nullable=True),
        *_columns(_f64, "visible_fraction", nullable=True),
        *_columns(_agreement, "mirror_agreement", nullable=True),
        *_columns(_f64, "projected_filled_share", "projected_hidden_share", "patch_object_fraction", nullable=True),
    ],
    "objects": [
        *_columns(_i64, "pose_id"),
        *_columns(_str, "role"),
        *_columns(_i64, "region_id", "scene_id"),
        *_columns(_str, "category", "instance_id"),
        *_columns(_i64, "u", "v"),
        *_columns(_matrix, "T_cam_obj"),
        *_columns(_array(_i64, 4), "bbox_xywh"),
        *_columns(_i64, "pixels"),
        *_columns(_f64, "visible_fraction"),
        *_columns(_f64, "patch_object_fraction", nullable=True),
    ],
    "assets": [
        *_columns(_str, "instance_id", "category", "source", "licence"),
        *_columns(_str, "path", nullable=True),
        *_columns(_str, "sha256"),
        *_columns(_array(_f64, 3), "extents_m"),
        *_columns(_f64, "volume_m3", nullable=True),
        *_columns(_bool, "watertight"),
        *_columns(_matrix, "T_source_to_object"),
        *_columns(_f64, "scale"),
        *_columns(_str, "split"),
        *_columns(pa.list_(_str), "notes", nullable=True),
    ],
    "failures": [
        *_columns(_i64, "scene_id"),
        *_columns(_str, "category", "stage", "kind", "reason", "detail"),
        *_columns(_i64, "attempts"),
    ],
    "timings": [
        *_columns(_i64, "scene_id"),
        *_columns(_str, "category"),
        *_columns(_seconds, "stages", "effects"),
        *_columns(_f64, "total_s"),
    ],
}

_left_out = pa.struct([*_columns(_i64, "number"), *_columns(_str, "status", "why")])
_capture_scene = pa.struct(
    [
        *_columns(_str, "name", "estimate"),
        *_columns(_str, "input_sha256", nullable=True),
        *_columns(_i64, "views", "markers"),
        *_columns(_f64, "reprojection_before_px", "reprojection_px", "depth_mm", nullable=True),
        *_columns(_f64, "depth_offset_m", "depth_scale", "print_scale"),
        *_columns(pa.list_(_str), "identified"),
        *_columns(_bool, "depth_corrected", "undistorted", "converged"),
        *_columns(_i64, "iterations", "cloud_points"),
        *_columns(_f64, "measured_share", nullable=True),
        *_columns(pa.list_(_left_out), "left_out"),
        *_columns(pa.list_(_str), "notes"),
        *_columns(_f64, "pose_mm", "pose_deg", "cloud_median_mm", "cloud_p95_mm", nullable=True),
        *_columns(_f64, "completeness", "depth_median_mm", nullable=True),
    ]
)
"""Quality of a capture. `views`: those that are used; `reprojection_before_px` is that of estimate `markers`, the others that
of `estimate`: medians over the used views. `identified`: parameters of the depth correction that the capture determines;
`depth_corrected`: whether stored depth is corrected by it. `left_out`: views that are not used. From `pose_mm` on: errors
against truth, null where there is none."""
_capture_view = pa.struct(
    [
        *_columns(_i64, "number", "markers"),
        *_columns(_f64, "reprojection_before_px", "reprojection_px", "depth_mm", nullable=True),
        *_columns(_f64, "pose_mm", "pose_deg", "measured_share", "depth_median_mm", nullable=True),
        *_columns(pa.list_(_i64), "sources", nullable=True),
    ]
)
"""One view of a capture: `number` in the names of its captured images, residuals before and after, errors against truth.
`depth_median_mm`, of input views: the error of the depth that the other views together give for it. `measured_share` and
`sources`, of mirror views: the share of what it shows that is measured and not filled, and the views that it is made of."""

_CAPTURE_COLUMNS: dict[str, pa.Field] = {
    "scenes": pa.field("capture", _capture_scene),
    "views": pa.field("capture", _capture_view),
}
"""The column that a table has in datasets of captures alone, behind all others."""

NOT_OF_CAPTURES = ("pose", *(field.name for field in _rest), "settle_s", "bodies")
"""Columns of `scenes` that a capture cannot have, since nothing was simulated to rest: null there."""


def _capture_fields(table: str, columns: list[pa.Field]) -> list[pa.Field]:
    if table not in _CAPTURE_COLUMNS:
        return columns
    return [
        *(field.with_nullable(True) if field.name in NOT_OF_CAPTURES else field for field in columns),
        _CAPTURE_COLUMNS[table],
    ]


def _schema(table: str, columns: list[pa.Field]) -> pa.Schema:
    return pa.schema(columns, {b"verso_table": table.encode(), b"schema_version": str(SCHEMA_VERSION).encode()})


SCHEMAS: dict[str, pa.Schema] = {table: _schema(table, columns) for table, columns in _COLUMNS.items()}
"""Of datasets of scenes."""

CAPTURE_SCHEMAS: dict[str, pa.Schema] = {
    table: _schema(table, _capture_fields(table, columns)) for table, columns in _COLUMNS.items()
}
"""Of datasets of captures: every column of a dataset of scenes, and those of captures. Reads rows of both."""


def schema_of(table: str, columns: Collection[str]) -> pa.Schema:
    """The schema of rows with these columns: that of captures where they have its column, else that of scenes."""
    own = _CAPTURE_COLUMNS.get(table)
    return (CAPTURE_SCHEMAS if own is not None and own.name in columns else SCHEMAS)[table]


SHAPE_FILE_COLUMNS = (pa.field("file_bytes", _i64), pa.field("file_sha256", _str))
"""More columns of `assets` in a range's own file: the size and the SHA-256 of the asset's shape, null where none is
stored. The merged table does not have them."""

SORT_KEYS: dict[str, tuple[str, ...]] = {
    "scenes": ("scene_id",),
    "views": ("pose_id", "role"),
    "objects": ("pose_id", "role", "region_id"),
    "assets": ("instance_id",),
    "failures": ("scene_id",),
    "timings": ("scene_id",),
}
"""The key of each table: unique, and the order of merged rows."""

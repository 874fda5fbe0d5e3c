"""The Arrow schemas and the keys of the six manifest tables."""

import pyarrow as pa

SCHEMA_VERSION = 1

TABLES = ("scenes", "views", "objects", "assets", "failures", "timings")
DETERMINISTIC_TABLES = ("scenes", "views", "objects", "assets", "failures")
"""Tables that are a function of job and seed: their canonical rows are in the dataset digest."""

_matrix = pa.list_(pa.field("item", pa.float64(), nullable=False), 16)
"""Row-major 4 x 4."""

_file = pa.struct(
    [pa.field("path", pa.string(), False), pa.field("bytes", pa.int64(), False), pa.field("sha256", pa.string(), False)]
)
_skip = pa.struct([pa.field("effect", pa.string(), False), pa.field("why", pa.string(), False)])
_body = pa.struct(
    [
        pa.field("region_id", pa.int64(), False),
        pa.field("category", pa.string(), False),
        pa.field("instance_id", pa.string(), False),
        pa.field("source", pa.string(), False),
        pa.field("object_scale", pa.float64(), False),
        pa.field("T_world_obj", _matrix, False),
        pa.field("redraws", pa.int64(), False),
        pa.field("penetration_mm", pa.float64(), False),
        pa.field("hover_gap_mm", pa.float64(), False),
        pa.field("support_margin_mm", pa.float64(), False),
        pa.field("residual_speed_mm_s", pa.float64(), False),
        pa.field("recheck_move_mm", pa.float64(), True),
        pa.field("recheck_turn_deg", pa.float64(), True),
        pa.field("equilibrium_residual", pa.float64(), False),
    ]
)
"""One object of a scene; the columns of `scenes` itself follow from these (codec.columns_of_bodies)."""
_agreement = pa.struct([pa.field("median_mm", pa.float64(), False), pa.field("share", pa.float64(), False)])
"""Input depth carried into the mirror view, compared with mirror depth: median difference, share within the bound."""
_seconds = pa.struct([pa.field("name", pa.string(), False), pa.field("seconds", pa.float64(), False)])


def _schema(name: str, fields: list[tuple[str, pa.DataType, bool]]) -> pa.Schema:
    meta = {b"verso_table": name.encode(), b"schema_version": str(SCHEMA_VERSION).encode()}
    return pa.schema([pa.field(n, t, nullable) for n, t, nullable in fields], metadata=meta)


_i64, _f64, _str, _bool = pa.int64(), pa.float64(), pa.string(), pa.bool_()

SCHEMAS: dict[str, pa.Schema] = {
    "scenes": _schema(
        "scenes",
        [
            ("scene_id", _i64, False),
            ("category", _str, False),
            ("instance_id", _str, False),
            ("source", _str, False),
            ("table_id", _str, False),
            ("object_scale", _f64, False),
            ("T_world_obj", _matrix, False),
            ("T_world_table", _matrix, False),
            ("pose", _str, False),
            ("redraws", _i64, False),
            ("effects", pa.list_(_str), False),
            ("skipped", pa.list_(_skip), False),
            ("penetration_mm", _f64, False),
            ("hover_gap_mm", _f64, False),
            ("support_margin_mm", _f64, False),
            ("residual_speed_mm_s", _f64, False),
            ("recheck_move_mm", _f64, True),
            ("recheck_turn_deg", _f64, True),
            ("equilibrium_residual", _f64, False),
            ("settle_s", _f64, False),
            ("raycast_checked", _bool, False),
            ("settings_digest", _str, False),
            ("bodies", pa.list_(_body), True),
        ],
    ),
    "views": _schema(
        "views",
        [
            ("pose_id", _i64, False),
            ("parent_id", _i64, False),
            ("role", _str, False),
            ("scene_id", _i64, False),
            ("category", _str, False),
            ("T_world_cam", _matrix, False),
            ("inclination_rad", _f64, False),
            ("yaw_rad", _f64, False),
            ("width", _i64, False),
            ("height", _i64, False),
            ("fx", _f64, False),
            ("fy", _f64, False),
            ("cx", _f64, False),
            ("cy", _f64, False),
            ("cx_opencv", _f64, False),
            ("cy_opencv", _f64, False),
            ("depth_units_per_m", _f64, False),
            ("d_z_m", _f64, False),
            ("files", pa.list_(_file), False),
            ("object_pixels", _i64, True),
            ("visible_fraction", _f64, True),
            ("mirror_agreement", _agreement, True),
            ("projected_filled_share", _f64, True),
            ("projected_hidden_share", _f64, True),
            ("patch_object_fraction", _f64, True),
        ],
    ),
    "objects": _schema(
        "objects",
        [
            ("pose_id", _i64, False),
            ("role", _str, False),
            ("region_id", _i64, False),
            ("scene_id", _i64, False),
            ("category", _str, False),
            ("instance_id", _str, False),
            ("u", _i64, False),
            ("v", _i64, False),
            ("T_cam_obj", _matrix, False),
            ("bbox_xywh", pa.list_(pa.field("item", _i64, nullable=False), 4), False),
            ("pixels", _i64, False),
            ("visible_fraction", _f64, False),
            ("patch_object_fraction", _f64, True),
        ],
    ),
    "assets": _schema(
        "assets",
        [
            ("instance_id", _str, False),
            ("category", _str, False),
            ("source", _str, False),
            ("licence", _str, False),
            ("path", _str, True),
            ("sha256", _str, False),
            ("extents_m", pa.list_(pa.field("item", _f64, nullable=False), 3), False),
            ("volume_m3", _f64, True),
            ("watertight", _bool, False),
            ("T_source_to_object", _matrix, False),
            ("scale", _f64, False),
            ("split", _str, False),
            ("notes", pa.list_(_str), True),
        ],
    ),
    "failures": _schema(
        "failures",
        [
            ("scene_id", _i64, False),
            ("category", _str, False),
            ("stage", _str, False),
            ("kind", _str, False),
            ("reason", _str, False),
            ("detail", _str, False),
            ("attempts", _i64, False),
        ],
    ),
    "timings": _schema(
        "timings",
        [
            ("scene_id", _i64, False),
            ("category", _str, False),
            ("stages", pa.list_(_seconds), False),
            ("effects", pa.list_(_seconds), False),
            ("total_s", _f64, False),
        ],
    ),
}

SORT_KEYS: dict[str, tuple[str, ...]] = {
    "scenes": ("scene_id",),
    "views": ("pose_id", "role"),
    "objects": ("pose_id", "role", "region_id"),
    "assets": ("instance_id",),
    "failures": ("scene_id",),
    "timings": ("scene_id",),
}
"""The key of each table: unique, and the order of merged rows."""

"""The errors that the study measures, each with the truth it is held against, which is never the setting under test."""

from dataclasses import dataclass

from services.study.model import Group

_RAYS = "a ray caster in float64 at the same pixel centres"
_FRONT = "65,536 rays about the objects, and their vertices"
_PATCH = "rays at random in the objects' patch"
_FINEST = "the finest steps, 1 s"
_TRUTH = "the truth of the simulation"
_REFERENCE = "finer steps than any that is measured"


@dataclass(frozen=True)
class ErrorKind:
    """One error: its unit, its name in a few words, its definition, what it is held against, and its part of a scene.

    A scene has one figure of it, and a setting the 95th percentile of its scenes' figures, or where it is `pooled` one
    figure over all its scenes. Less is better.
    """

    name: str
    unit: str
    short: str
    title: str
    truth: str
    group: Group
    pooled: bool = False


# fmt: off
ERRORS = {kind.name: kind for kind in (
    ErrorKind("penetration_mm", "mm", "penetration",
              "how deep an object stands in what it rests on", "the stored shapes", "physics"),
    ErrorKind("gap_mm", "mm", "gap", "how high an object hovers", "the stored shapes", "physics"),
    ErrorKind("unbalanced_share", "", "weight out of balance",
              "share of a weight that contacts leave out of balance", "the stored shapes", "physics"),
    ErrorKind("moved_mm", "mm", "motion when let go again",
              "how far an object moves when it is let go again", _FINEST, "physics"),
    ErrorKind("turned_deg", "deg", "turn when let go again",
              "how far it turns when it is let go again", _FINEST, "physics"),
    ErrorKind("pose_mm", "mm", "pose", "pose off, where two finer settings agree", _REFERENCE, "physics"),
    ErrorKind("outcome_mm", "mm", "where things end, on the whole",
              "how far things slide and roll: two distributions apart", _REFERENCE, "physics", True),
    ErrorKind("outcome_deg", "deg", "how they lie, on the whole",
              "how far things turn: two distributions apart", _REFERENCE, "physics", True),
    ErrorKind("failed_share", "", "scenes that fail", "scenes that do not come to rest", "counted", "physics", True),
    ErrorKind("depth_mm", "mm", "depth of objects", "stored depth of objects off, 99 % of pixels", _RAYS, "labels"),
    ErrorKind("table_depth_mm", "mm", "depth of the table",
              "stored depth of the table off, 99 % of pixels", _RAYS, "labels"),
    ErrorKind("mask_share", "", "the object's mask pixels",
              "object pixels that are wrong in the mask", _RAYS, "labels"),
    ErrorKind("between_mm", "mm", "depth between pixels",
              "depth between pixels, read at the nearest", _PATCH, "labels"),
    ErrorKind("outline_share", "", "regions between pixels",
              "rays at random whose region the nearest pixel has wrong", _PATCH, "labels"),
    ErrorKind("mirror_mm", "mm", "mirror camera", "mirror camera off, as d_z is", _FRONT, "mirror"),
    ErrorKind("agreement_mm", "mm", "agreement of the views",
              "input depth carried into the mirror view, off", "the mirror view", "mirror"),
    ErrorKind("unfilled_share", "", "projected pixels left empty",
              "object pixels of the mirror view seen by both that stay empty", _RAYS, "mirror"),
    ErrorKind("hidden_share", "", "projected pixels that show through",
              "projected pixels that show what the mirror camera cannot see", _RAYS, "mirror"),
    ErrorKind("camera_mm", "mm", "camera position", "camera position off, median of a capture's views", _TRUTH, "capture"),
    ErrorKind("camera_deg", "deg", "camera rotation", "camera rotation off, median of its views", _TRUTH, "capture"),
    ErrorKind("cloud_mm", "mm", "merged cloud", "points of the merged cloud off, median", _TRUTH, "capture"),
    ErrorKind("cloud_p95_mm", "mm", "merged cloud, 95 %",
              "points of the merged cloud off, 95 % of them", _TRUTH, "capture"),
    ErrorKind("missing_share", "", "surface that is missing",
              "visible surface without a point within 3 mm", _TRUTH, "capture"),
    ErrorKind("view_depth_mm", "mm", "depth of synthesised views",
              "depth of synthesised views off, median", _TRUTH, "capture"),
    ErrorKind("flip", "", "colour, FLIP", "colour: FLIP, 0 the same to 1", "a converged path-traced image", "colour"),
    ErrorKind("edge_flip", "", "edges, FLIP",
              "smoothness of edges: FLIP, 0 the same to 1", "64 samples a pixel, same light", "colour"),
)}
# fmt: on
"""By name."""

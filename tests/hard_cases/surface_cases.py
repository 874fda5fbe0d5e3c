"""The table of hard cases for what is merged of a capture: the cloud within its bound, or why there is none.

A board with a sphere and a box on it, or flat things, seen by twenty views whose depth has twice an Azure Kinect's noise.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from schemas.job.captures import Fusion
from tests.hard_cases.camera_cases import HOLD
from tests.hard_cases.case import refuse
from tests.workers.capture.analytic_capture import BOARD, Thing, capture, cast
from workers.capture.surface.fusion import fuse_views
from workers.capture.surface.object_mask import find_object
from workers.capture.surface.posed_view import PosedView
from workers.geometry.frames import invert, transform

SIGMA_M = 0.003
"""Noise of a depth pixel at 1 m."""

P95_MM = 3.0
"""Of the distances of the cloud to the object: the bar of a capture of full size."""

Spoil = Callable[[PosedView], None]


@dataclass(frozen=True, eq=False)
class SurfaceCase:
    """One row: what is on the board, what happens to each view's depth, and the least points that must come out."""

    name: str
    outcome: str
    thing: Thing = field(default_factory=Thing)
    spoil: Spoil = lambda view: None
    views: int = 20
    fusion: Fusion = field(default_factory=Fusion)
    least_points: int = 5000


def p95_mm(case: SurfaceCase, seed: int = 0) -> float:
    """95th percentile of the cloud's distances to the object, mm, with the seed of the noise. Raises CaptureError."""
    views = capture(case.thing, count=case.views, sigma_m=SIGMA_M, seed=3 + seed)
    for view in views:
        case.spoil(view)
    found = fuse_views(views, find_object(views, BOARD, case.fusion), case.fusion)
    for values in (found.points, found.normals, found.vertices):
        assert np.isfinite(values).all()
    assert len(found.points) >= case.least_points, f"{len(found.points)} points"
    return 1e3 * float(np.quantile(case.thing.distance(found.points), 0.95))


def flat(height_m: float) -> Thing:
    return Thing(sphere=None, boxes=[(np.array([-0.05, -0.04, 0.0]), np.array([0.06, 0.04, height_m]))])


def no_depth_where(inside: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """No depth on the points of the object or board, [N, 3] in the board frame, that a condition names."""

    def spoil(view: PosedView) -> None:
        rows, columns = np.nonzero(view.depth_m)
        z, k = view.depth_m[rows, columns].astype(np.float64), view.depth_camera.intrinsics
        points = np.stack([(columns + 0.5 - k.cx) / k.fx * z, (rows + 0.5 - k.cy) / k.fy * z, z], axis=1)
        gone = inside(transform(view.depth_camera.T_world_cam, points))
        view.depth_m[rows[gone], columns[gone]] = 0.0

    return spoil


def transparent(view: PosedView) -> None:
    """A sphere of glass: no depth on it, nor of what is behind it."""
    behind, seen = (cast(thing, view.depth_camera)[0] for thing in (Thing(sphere=None), Thing()))
    view.depth_m[(seen > 0) & (behind > seen + 0.001)] = 0.0


def glint(view: PosedView) -> None:
    """A shiny spot that moves with the camera: where the sphere's normal points at it, depth is missing."""
    eye = transform(invert(view.depth_camera.T_world_cam), np.array([[-0.06, 0.0, 0.07]]))[0]
    k = view.depth_camera.intrinsics
    u, v = k.fx * eye[0] / eye[2] + k.cx, k.fy * eye[1] / eye[2] + k.cy
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    view.depth_m[np.hypot(columns - u, rows - v) < 8] = 0.0


def nothing_left(view: PosedView) -> None:
    view.depth_m[:] = 0.0


SURFACES = (
    SurfaceCase("the usual object", HOLD, least_points=20_000),
    SurfaceCase("a shiny spot without depth that moves with the camera", HOLD, spoil=glint, least_points=20_000),
    SurfaceCase(
        "a shiny half without depth",
        HOLD,
        spoil=no_depth_where(lambda p: (p[:, 0] < -0.06) & (p[:, 2] > 0.005)),
        least_points=15_000,
    ),
    SurfaceCase(
        "a transparent sphere in front of a box", HOLD, Thing(sphere=None), spoil=transparent, least_points=8_000
    ),
    SurfaceCase("an object of 4 mm", HOLD, thing=flat(0.004), least_points=2_200),
    SurfaceCase(
        "an object of 4 mm below a clearance of 6 mm",
        refuse("no_object"),
        thing=flat(0.004),
        fusion=Fusion(board_clearance_m=0.006),
    ),
    SurfaceCase("an object of 1 mm", refuse("no_object"), thing=flat(0.001)),
    SurfaceCase("an empty board", refuse("no_object"), thing=Thing(sphere=None, boxes=[])),
    SurfaceCase("no depth anywhere", refuse("no_depth"), spoil=nothing_left),
    SurfaceCase(
        "no depth on half of the board",
        HOLD,
        spoil=no_depth_where(lambda p: (p[:, 1] > 0.06) & (p[:, 2] < 0.005)),
        least_points=20_000,
    ),
    SurfaceCase("no depth on the board at all", refuse("no_depth"), spoil=no_depth_where(lambda p: p[:, 2] < 0.03)),
    SurfaceCase("no depth on the object", refuse("no_object"), spoil=no_depth_where(lambda p: p[:, 2] > 0.002)),
    SurfaceCase("one view", refuse("too_few_views"), views=1),
    SurfaceCase("one view that is enough", HOLD, views=1, fusion=Fusion(min_views=1), least_points=2_000),
    SurfaceCase("two views", HOLD, views=2, least_points=500),
)

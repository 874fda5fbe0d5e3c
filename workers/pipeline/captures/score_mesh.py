"""A processed capture against a mesh that the user gives, in a frame of its own."""

from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.align import Alignment, align_mesh
from workers.capture.evaluate import SurfaceErrors
from workers.geometry.frames import transform
from workers.pipeline.captures.score import score_surface
from workers.pipeline.captures.stored_result import StoredResult


def score_against_mesh(result: StoredResult, mesh: Mesh) -> tuple[SurfaceErrors, Alignment]:
    """The surface's errors after the mesh is aligned to the cloud; what is visible follows from the estimated poses."""
    alignment = align_mesh(result.surface.points, mesh)
    placed = Mesh(transform(alignment.T_board_obj, mesh.vertices), mesh.faces)
    k = result.folder.camera.intrinsics
    cameras = [Camera(k, view.T_board_cam) for view in result.estimate.used if view.T_board_cam is not None]
    return score_surface(result.surface, placed, cameras), alignment

"""Format `gltf`: a GLB file for each scene, posed geometry and cameras, for people who look at it in their own viewer.

glTF's y is up, the world's z is: a root node turns one into the other. Below it all is as in the dataset, in metres.
"""

import math
from functools import cached_property
from typing import Any, ClassVar

from schemas.dataset.codec import Row, read_matrix
from schemas.errors import CorruptError, SceneError, VersoError
from schemas.scene.view import DRAWN_ROLES
from services.export.formats import Added, Writer
from services.export.source import OPENGL_FROM_OPTICAL, ExportScene
from services.read.scene_geometry import Sources, pose_shapes
from workers.assets.glb import join_glb
from workers.door.opening import split_glb

NO_SOURCES = "the sources of the shapes are not here, or have changed"

_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""x, y, z, w of the rotation that takes z to y."""
_NEAR_M = 0.05


class Gltf(Writer):
    """Writes <category>/<scene id>.glb."""

    FRESH: ClassVar = {"files": {}}

    def add(self, scene: ExportScene) -> Added:
        """Writes the scene's file."""
        try:
            posed = pose_shapes(self.store, scene.stored, scene.row, self.record, self._sources)
        except CorruptError:
            raise
        except SceneError as error:
            return _left_out(scene, f"its shapes cannot be made again: {error.reason}")
        except (VersoError, OSError):
            return _left_out(scene, NO_SOURCES)
        data: bytes = posed.export(file_type="glb")
        seen = with_cameras(
            data, [pair.views[role] for pair in scene.pairs for role in DRAWN_ROLES if role in pair.views]
        )
        self.folder.put(f"{scene.category}/{scene.scene_id:06d}.glb", seen)
        self.count("files", scene.category, 1)
        return Added(len(scene.pairs))

    @cached_property
    def _sources(self) -> Sources:
        return Sources(self.record)

    def describe(self) -> dict[str, Any]:
        """Files by category, and the frame."""
        return {
            "files": dict(sorted(self.kept["files"].items())),
            "not_exported": ["images and labels: the cameras stand where the views were taken from"],
            "frame": "metres; below the root node the world frame of the dataset, z up, turned to glTF's y up by that node",
            "cameras": "named by role and pose id; a field of view and an aspect ratio, without the principal point",
        }


def _left_out(scene: ExportScene, reason: str) -> Added:
    return Added(0, tuple((pair.pose_id, reason) for pair in scene.pairs))


def with_cameras(glb: bytes, views: list[Row]) -> bytes:
    """A GLB file with a camera for each row of `views`, and a root node that turns the world's z up to glTF's y."""
    tree, binary = split_glb(glb)
    nodes, cameras = tree["nodes"], tree.setdefault("cameras", [])
    roots = list(tree["scenes"][0]["nodes"])
    for view in views:
        matrix = read_matrix(view["T_world_cam"]) @ OPENGL_FROM_OPTICAL
        name = f"{view['role']} {view['pose_id']}"
        roots.append(len(nodes))
        nodes.append({"name": name, "camera": len(cameras), "matrix": matrix.T.ravel().tolist()})
        cameras.append({"name": name, "type": "perspective", "perspective": _perspective(view)})
    tree["scenes"][0]["nodes"] = [len(nodes)]
    nodes.append({"name": "z up", "rotation": _Y_UP, "children": roots})
    return join_glb(tree, binary)


def _perspective(view: Row) -> dict[str, float]:
    width, height = view["width"] / view["fx"], view["height"] / view["fy"]
    return {"yfov": 2.0 * math.atan(0.5 * height), "aspectRatio": width / height, "znear": _NEAR_M}

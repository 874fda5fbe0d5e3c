"""The ray casts of one scene's geometry, kept from setting to setting while its poses stay."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from schemas.scene.scene import Placed
from schemas.scene.view import Camera
from services.study.measure.rays import Patch, Pixels, cast_patch, cast_pixels, seen_by_other
from workers.scene.make_scene import Scene

KEPT = 12
"""Casts kept of a scene, some 0.3 MB each: the last ones used. Every setting uses the input camera's; the mirror camera moves
whenever d_z changes."""

Key = tuple[object, ...]
Answer = TypeVar("Answer")


class Truth:
    """Casts of rays in one scene, with a cache of the last ones."""

    def __init__(self, scene: Scene) -> None:
        self.scene_id = scene.plan.scene_id
        self.things = scene.posed.things
        self._kept: LRUCache[Key, object] = LRUCache(KEPT)

    def fits(self, scene: Scene) -> bool:
        """Whether the scene has the same shapes at the same poses."""
        alike = self.scene_id == scene.plan.scene_id and len(self.things) == len(scene.posed.things)
        return alike and all(map(_same, self.things, scene.posed.things))

    def pixels(self, camera: Camera) -> Pixels:
        """The view at its pixels."""
        return self._keep(("pixels", *_key(camera)), lambda: cast_pixels(self.things, camera))

    def patch(self, camera: Camera, pair: int) -> Patch:
        """The objects in a pair's input view, the same for images of all sizes."""
        k = camera.intrinsics
        # To 12 digits: a camera scaled to another size is the same one but for rounding.
        frame = [round(x, 12) for x in (k.fx / k.width, k.fy / k.height, k.cx / k.width, k.cy / k.height)]
        key = ("patch", pair, *frame, camera.T_world_cam.tobytes())
        return self._keep(key, lambda: cast_patch(self.things, camera, self.scene_id, pair))

    def both(self, camera: Camera, other: Camera) -> NDArray[np.bool_]:
        """[N] bool: which pixels of `pixels(camera).box` show an object point that the other camera sees too."""
        key = ("both", *_key(camera), *_key(other))
        return self._keep(key, lambda: seen_by_other(self.things, camera, self.pixels(camera).box, other))

    def _keep(self, key: Key, cast: Callable[[], Answer]) -> Answer:
        if key not in self._kept:
            self._kept[key] = cast()
        return self._kept[key]  # type: ignore[return-value]


def truth_of(scene: Scene, kept: Truth | None = None) -> Truth:
    """The truth of a scene: `kept`, of an earlier setting, where the geometry is the same, or a new one."""
    return kept if kept is not None and kept.fits(scene) else Truth(scene)


def _key(camera: Camera) -> Key:
    return *camera.intrinsics.model_dump().values(), camera.T_world_cam.tobytes()


def _same(mine: Placed, other: Placed) -> bool:
    if mine.region_id != other.region_id or not np.array_equal(mine.T_world_shape, other.T_world_shape):
        return False
    return mine.shape is other.shape or (
        np.array_equal(mine.shape.vertices, other.shape.vertices)
        and np.array_equal(mine.shape.faces, other.shape.faces)
    )

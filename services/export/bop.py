"""Format `bop`: the scenewise layout of the BOP benchmark (6-D object pose), one BOP scene for each scene of the dataset.

Images of a scene are the input, aligned and mirror views of its pairs. Poses are model to camera in millimetres, K has pixel
centres on integers, as OpenCV has them. A scene's folder appears whole.
"""

from typing import Any

from services.export.bop_models import BopModels
from services.export.bop_scene import SceneDraft, encode_json
from services.export.folder import ExportFolder
from services.export.shapes import Shapes
from services.export.source import ExportScene
from services.export.writer import Added, LeftOut
from services.job.record import JobRecord
from workers.store.store import Store


class Bop:
    """Writes train/, val/ and test/ with a folder for each scene, and models/."""

    def __init__(self, store: Store, record: JobRecord, folder: ExportFolder, state: dict[str, Any] | None) -> None:
        self._folder = folder
        self._shapes = Shapes(store, record)
        self._models = BopModels(folder, None if state is None else state["models"])
        self._camera: dict[str, Any] | None = None if state is None else state["camera"]
        self._splits: dict[str, int] = {} if state is None else dict(state["splits"])
        self._images = 0 if state is None else int(state["images"])

    def add(self, scene: ExportScene) -> Added:
        """Writes the scene's folder with its pairs that are whole."""
        numbers = {region: self._number(scene, name) for region, (_, name) in scene.instances.items()}
        draft = SceneDraft(self._folder, scene, numbers, self._shapes)
        left_out = []
        for pair in scene.pairs:
            if reason := draft.add(pair):
                left_out.append(LeftOut(scene.scene_id, pair.pose_id, reason))
        written = len(scene.pairs) - len(left_out)
        if written:
            draft.install(f"{scene.split}/{scene.scene_id:06d}")
            self._splits[scene.split] = self._splits.get(scene.split, 0) + 1
            self._images += len(draft.cameras)
            self._camera = self._camera or draft.sensor
        return Added(written, tuple(left_out))

    def _number(self, scene: ExportScene, instance_id: str) -> int:
        known = self._models.number(instance_id)
        if known is not None:
            return known
        return self._models.add(scene.assets[instance_id], self._shapes.load(scene, instance_id))

    def state(self) -> dict[str, Any]:
        """Numbers of objects, and counts."""
        models = self._models.state()
        return {"models": models, "camera": self._camera, "splits": self._splits, "images": self._images}

    def finish(self) -> None:
        """Writes camera.json and ends the list of models."""
        self._models.finish()
        self._folder.put("camera.json", encode_json(self._camera or {}))

    def close(self) -> None:
        """Closes the list of objects."""
        self._models.close()

    def describe(self) -> dict[str, Any]:
        """Counts, units and frames."""
        missing = self._models.without
        return {
            "bop_scenes": dict(sorted(self._splits.items())),
            "images": self._images,
            "models": self._models.count - missing,
            "not_exported": [
                *([f"{missing} models: neither their shapes nor the job's sources are here"] if missing else []),
                "the table and the floor as objects, projected views, patches, textures (models have vertex colours)",
            ],
            "poses": "model to camera, and world to camera; millimetres, optical frame (x right, y down, z forward)",
            "models_frame": "millimetres, z up, origin at the centre of the bounding box",
            "pixels": "cam_K has pixel centres on integers, as OpenCV has them",
            "depth": "millimetres are the stored value times depth_scale, z along the optical axis",
        }

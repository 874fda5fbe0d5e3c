"""The items of a pair: what is true, what is predicted, whether it can be scored, and its scores. A row for each item.

An item is a kind of prediction, a pose id and, for shapes, volumes and poses, a region. Every pair of the split has an item of
every kind that is predicted at all. Its status is `ok`, `missing`, or `refused` with a reason. A prediction that is no item has
`outside`, of another split, or `unknown`. Columns of metrics are named kind_metric_unit, for parts of an image
kind_metric_part_unit: `depth_mae_m` is that of the object, `depth_mae_hidden_m` of the part of it that the input view does not
see.

Parts of the mirror view: `object`, all pixels of objects; `seen` and `hidden`, those of them with depth whose surface the input
camera sees and does not: by the image `covisible`, which is exact, or where the job stores none by the pixels of the input view
(services/dataset/pair.py), which hide some hundredths too many; `boundary`, within two pixels of an object's outline; `scene`,
all with depth; `image`, all. The scene's floor and table are not in `seen` and `hidden`: an object has one pixel in a hundred,
and they would drown it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import expit

from schemas.base import Array
from schemas.dataset.codec import Row, read_matrix
from schemas.errors import InputError, VersoError
from schemas.job.assets import Split
from schemas.job.job import Job
from schemas.scene.shape import REGION_FIRST_OBJECT, Mesh, is_object
from services.dataset.pair import Pair, carry
from services.dataset.view import View
from services.score.images import Alignment, align_depth, score_colour, score_depth
from services.score.pose import INVERTED, box_of, check_distance, correlation, score_pose, score_volume, symmetries_of
from services.score.predictions import Key, file_in, read_array, read_image, read_pose, read_shape
from workers.door.opening import as_refusal
from workers.geometry.frames import invert, transform

LEVELS: Final[Mapping[str, tuple[Split, Callable[[int], bool]]]] = {
    "1": ("test", lambda objects: objects == 1),
    "2": ("test", lambda objects: objects > 1),
    "3": ("test", lambda objects: True),
    "4": ("unseen", lambda objects: True),
}
"""Levels of the benchmark (docs/benchmark.md): the split, and how many objects a scene has. Level 3 has a noisy input view."""

Volume = Literal["auto", "occupancy", "logits", "sdf", "sdf-positive-inside"]
"""What predicted values at a volume's points are; `auto`: occupancy from 0 to 1, or distance, by the values themselves."""

PredictedFrame = Literal["object", "camera", "input", "world"]
FRAMES: Final[tuple[PredictedFrame, ...]] = get_args(PredictedFrame)
"""The frame of predicted shapes: the object's, the mirror camera's, the input camera's, the world's."""

SEEN_TOLERANCE_M: Final = 0.001
"""How far behind the input view's surface a point may lie that it sees: as `Pair.correspondence`."""

COLOURED: Final = ("object", "hidden", "boundary")
"""The parts on which RGB is scored, beside the whole image: there the table and the floor count most."""

BOUNDARY_PX: Final = 2
LEAST_PIXELS: Final = 50
"""Pixels with truth and prediction without which neither unit nor sign is judged."""

JUDGED_PIXELS: Final = 10_000
"""About how many pixels, spread over the image, are looked at for them: all 307,200 take a quarter of the time of scoring."""

UNIT_SLACK: Final = 1.25
"""A median ratio to the truth within this factor of that of a unit is that unit."""

SIZE_SLACK: Final = 3.0
"""Most ratio of the diagonals of a predicted and the true box, and most distance of their centres in diagonals."""

_UNITS: Final = {1e3: "millimetres", 1e2: "centimetres", 1e-3: "kilometres: it was divided by 1,000 once too often"}


@dataclass(frozen=True)
class Asked:
    """What the command line asks for."""

    kinds: tuple[str, ...]
    frame: PredictedFrame = "object"
    split: Split | Literal["all"] = "all"
    """Which scenes are scored: all, or those whose objects all are of instances of one split."""
    level: str = "all"
    """Which of them: those of a level of `LEVELS`, whose split `split` is then."""
    volume: Volume = "auto"
    samples: int = 10_000
    """Points drawn on a surface."""
    seed: int = 0
    align: Alignment = "none"
    check: bool = False
    """Whether predictions are read and held against units, sizes and places alone, and not scored but for holes."""
    flip: bool = False
    """Whether FLIP is among the metrics of RGB: it takes 0.7 s an image of 640 x 480."""

    def __post_init__(self) -> None:
        """Raises InputError where a level is not of the split that is named beside it."""
        if self.level != "all":
            split = LEVELS[self.level][0]
            if self.split not in ("all", split):
                raise InputError(f"level {self.level} is of the split {split}: leave --split {self.split} out")
            object.__setattr__(self, "split", split)


def column(kind: str, name: str) -> str:
    """The column of a metric as the scoring functions name it: ("depth", "hidden.mae_m") is `depth_mae_hidden_m`."""
    if kind not in ("depth", "rgb"):
        return f"{kind}_{name.replace('.', '_')}"
    part, _, metric = name.partition(".")
    infix = "" if part == "object" else f"_{part}"
    unit = next((unit for unit in ("_m", "_db") if metric.endswith(unit)), "")
    return f"{kind}_{metric.removesuffix(unit)}{infix}{unit}"


def score_pair(
    pair: Pair, folder: Path, predicted: Mapping[Key, tuple[str, ...]], asked: Asked, job: Job, blame: str = ""
) -> list[Row]:
    """A row for each item of a pair of the dataset of `job`; with `blame`, why its predictions are refused unread.

    Raises InputError where the dataset has no mirror view, CorruptError where it is damaged.
    """
    if pair.mirror is None:
        raise InputError("the dataset has no mirror view to score: its job's cameras.mirror.enabled is false")
    truth, rows = Truth(pair, pair.mirror, job.images.depth_range_m.high), []
    bodies = pair.scene["bodies"] or [pair.scene]
    splits = {job.assets.split.of(body["instance_id"]) for body in bodies}
    split = splits.pop() if len(splits) == 1 else "mixed"
    chosen = asked.split in ("all", split) and (asked.level == "all" or LEVELS[asked.level][1](len(bodies)))
    for kind in asked.kinds:
        for region in [0] if kind in ("depth", "rgb") else truth.regions:
            label = pair.mirror.regions.get(region or REGION_FIRST_OBJECT)
            row: Row = {
                "kind": kind,
                "pose_id": pair.mirror.pose_id,
                "scene_id": pair.scene_id,
                "split": split,
                "category": label["category"] if label else pair.category,
                "instance": label["instance_id"] if label else pair.instance_id,
                "region": region,
                "visible_fraction": pair.input.visible_fraction,
                "diagonal_m": truth.diagonal_m(region or REGION_FIRST_OBJECT),
                "farthest_m": truth.farthest_m,
            }
            names = predicted.get((kind, pair.mirror.pose_id, region), ())
            if not chosen:
                rows += [row | {"status": "outside"}] if names else []
                continue
            row |= {column(kind, f"{part}.pixels"): count for part, count in truth.pixels(kind).items()}
            if names and blame:
                rows.append(row | {"status": "refused", "reason": blame})
            else:
                rows.append(row | _score(kind, names, region, truth, folder, asked))
    return rows


def _score(kind: str, names: tuple[str, ...], region: int, truth: "Truth", folder: Path, asked: Asked) -> Row:
    """Status, reason and metrics of one item."""
    if not names:
        return {"status": "missing", "reason": None}
    prepared = truth.prepare(kind, region, asked)
    try:
        if len(names) > 1:
            where = f"{len(names)} lines of poses.csv" if kind == "pose" else ", ".join(names)
            raise InputError(f"the id is there {len(names)} times: {where}")
        with as_refusal(f"{kind} {names[0]}"):
            prediction = file_in(folder, f"{kind}/{names[0]}") if kind != "pose" else names[0]
            scorer = _READERS[kind](prediction, region, prepared, truth, asked)
            scores, note = scorer() if kind == "depth" or not asked.check else ({}, None)
    except VersoError as error:
        return {"status": "refused", "reason": str(error).replace(f"{folder}/", "")}
    return {"status": "ok", "reason": note} | {column(kind, name): value for name, value in scores.items()}


class Truth:
    """What is true of a pair; images are decoded once, and only when asked for. Raises CorruptError where they are damaged.

    farthest_m: the end of the depths that the dataset stores, so that no error of depth need be larger.
    """

    def __init__(self, pair: Pair, mirror: View, farthest_m: float) -> None:
        self.pair, self.view, self.farthest_m = pair, mirror, farthest_m
        self.regions = [region for region in sorted(pair.T_world) if region >= REGION_FIRST_OBJECT]

    def diagonal_m(self, region: int) -> float:
        """Of the object's bounding box; nan where nothing is known of it."""
        label = self.view.regions.get(region)
        asset = label["asset"] if label else self.pair.asset
        return float(np.linalg.norm(asset["extents_m"])) if asset.get("extents_m") else float("nan")

    @cached_property
    def units(self) -> NDArray[np.uint16]:
        """[H, W] stored depth."""
        return self.view.depth()

    @cached_property
    def depth_m(self) -> Array:
        """[H, W] float64 metres."""
        return self.units / self.view.depth_units_per_m

    @cached_property
    def segment(self) -> NDArray[np.uint8]:
        """[H, W] region ids."""
        return self.view.segment()

    @cached_property
    def parts(self) -> Mapping[str, NDArray[np.bool_]]:
        """[H, W] bool by name, as the head of this file has them."""
        mask = is_object(self.segment)
        if "covisible" in self.view.images:
            seen = self.view.covisible() & (self.units > 0)
        else:
            rows, columns = np.divmod(np.flatnonzero(mask & (self.units > 0)), mask.shape[1])
            z_m, region = self.depth_m[rows, columns], self.segment[rows, columns]
            seen = np.zeros(mask.shape, np.bool_)
            seen[rows, columns] = carry(self.view, self.pair.input, rows, columns, z_m, region, SEEN_TOLERANCE_M)[1]
        return {
            "object": mask,
            "scene": self.units > 0,
            "seen": seen,
            "hidden": mask & ~seen & (self.units > 0),
            "boundary": _outline(self.segment),
        }

    def pixels(self, kind: str) -> Mapping[str, int]:
        """How many pixels each part has that predictions of a kind are held against: without any it has no metrics."""
        if kind == "depth":
            return {name: int(np.count_nonzero(part & (self.units > 0))) for name, part in self.parts.items()}
        return {name: int(np.count_nonzero(self.parts[name])) for name in COLOURED} if kind == "rgb" else {}

    def shape(self, region: int, frame: PredictedFrame) -> Mesh:
        """The object's surface, one vertex at a place, in a frame, metres."""
        mesh = self.pair.mesh(region, welded=True)
        poses = {"object": self.pair.T_world[region], "camera": self.view.T_world_cam, "world": np.eye(4)}
        T_world_frame = poses.get(frame, self.pair.input.T_world_cam)
        vertices = transform(invert(T_world_frame), np.asarray(mesh.vertices))
        return Mesh(vertices, np.asarray(mesh.faces, np.int32))

    def prepare(self, kind: str, region: int, asked: Asked) -> Any:
        """What an item is held against. Raises InputError where the dataset does not store it."""
        if kind == "depth":
            return self.depth_m, self.parts
        if kind == "rgb":
            return self.view.rgb(), {name: self.parts[name] for name in COLOURED}
        if kind == "volume":
            stored = self.pair.samples(region)
            if "volume_distance" not in stored and "volume_occupancy" not in stored:
                raise InputError("the dataset stores no volume samples: its job's targets.shape names none")
            return stored
        return self.shape(region, asked.frame if kind == "shape" else "object")


def _outline(segment: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """[H, W]: pixels within `BOUNDARY_PX` of another region, if either is of an object."""
    outline = np.zeros(segment.shape, np.bool_)
    rows, columns = np.divmod(np.flatnonzero(is_object(segment)), segment.shape[1])  # 4 times nonzero's speed
    if not len(rows):
        return outline
    near = tuple(
        slice(max(int(at.min()) - BOUNDARY_PX - 1, 0), int(at.max()) + BOUNDARY_PX + 2) for at in (rows, columns)
    )
    crop = np.where(is_object(segment[near]), segment[near], 0)
    size = 2 * BOUNDARY_PX + 1
    outline[near] = ndimage.maximum_filter(crop, size, mode="nearest") != ndimage.minimum_filter(
        crop, size, mode="nearest"
    )
    return outline


# ---------------------------------------------------------------------------------------------- one item of each kind

Scorer = Callable[[], tuple[Mapping[str, float | None], str | None]]
"""Makes the metrics by name, and a note, of a prediction that is read."""


def _read_depth(path: Path, region: int, prepared: Any, truth: Truth, asked: Asked) -> Scorer:
    true_m, parts = prepared
    predicted_m = read_image(path, true_m.shape, truth.view.depth_units_per_m)
    units_per_m = truth.view.depth_units_per_m if asked.align == "none" else None
    check_depth(predicted_m, true_m, units_per_m, parts["object"])
    if asked.check:
        parts = {"object": parts["object"]}
    aligned_m = align_depth(predicted_m, true_m, asked.align)
    return lambda: (score_depth(aligned_m, true_m, parts, truth.farthest_m), None)


def check_depth(predicted_m: Array, true_m: Array, units_per_m: float | None, mask: NDArray[np.bool_]) -> None:
    """Raises InputError where depth [H, W] is in another unit than metres, or inverted: it is said and not mended.

    units_per_m: of stored images; None where depth is aligned, so that its unit does not matter. mask [H, W]: objects, where
    inverted depth is inverted as well, and a poor guess of what is about them need not be.
    """
    every = max(1, true_m.size // JUDGED_PIXELS)  # a step that shares no factor with the width, to reach all columns
    while np.gcd(every, true_m.shape[1]) > 1:
        every += 1
    predicted, true = predicted_m.ravel()[::every], true_m.ravel()[::every]
    both = (predicted > 0.0) & (true > 0.0)
    if np.count_nonzero(both) < LEAST_PIXELS:
        return
    predicted, true = predicted[both], true[both]
    at = np.flatnonzero(mask)
    objects, likeness = np.stack([predicted_m.ravel()[at], true_m.ravel()[at]]), correlation(predicted, true)
    objects = objects[:, (objects > 0.0).all(axis=0)]
    likeness = max(likeness, correlation(*objects) if objects.size else -1.0)
    if likeness < INVERTED:  # before the unit: disparity may look like another one
        raise InputError(f"depth is inverted: its correlation with the truth is {likeness:.2f}")
    if units_per_m is None:
        return
    ratio = float(np.median(predicted / true))
    units = _UNITS | {units_per_m: "the units of stored images", 1e3 / units_per_m: "a PNG of millimetres"}
    for factor, unit in units.items():
        if max(factor, 1.0 / factor) > SIZE_SLACK and max(ratio / factor, factor / ratio) < UNIT_SLACK:
            remedy = f"{units_per_m:g} units a metre in a PNG, metres in an array"
            raise InputError(f"depth is {ratio:.4g} times the truth: it seems to be {unit}; write {remedy}")


def _read_rgb(path: Path, region: int, prepared: Any, truth: Truth, asked: Asked) -> Scorer:
    true, parts = prepared
    predicted = read_image(path, true.shape)
    return lambda: (score_colour(predicted, true, parts, flip=asked.flip), None)


def _read_shape(path: Path, region: int, prepared: Any, truth: Truth, asked: Asked) -> Scorer:
    from services.score.shape import align_shape, score_shape  # loads what makes data

    predicted = read_shape(path)
    predicted, _ = align_shape(predicted, prepared, asked.align, asked.seed)
    points = predicted.vertices if isinstance(predicted, Mesh) else predicted
    check_box(points, prepared.vertices, lambda frame: truth.shape(region, frame).vertices)

    def score() -> tuple[Mapping[str, float | None], str | None]:
        scores = score_shape(predicted, prepared, truth.diagonal_m(region), asked.samples, asked.seed)
        open_mesh = isinstance(predicted, Mesh) and scores.get("iou") is None
        return scores, "the mesh has no volume: its IoU counts as 0" if open_mesh else None

    return score


def check_box(points: Array, true: Array, true_in: Callable[[PredictedFrame], Array]) -> None:
    """Raises InputError where the box of points [N, 3] has another size or place than the true one, with what would fit.

    true [M, 3]: vertices in the frame that was asked for; true_in: in another.
    """
    centre, size = box_of(points)
    true_centre, true_size = box_of(true)
    ratio = size / true_size
    if not 1.0 / SIZE_SLACK <= ratio <= SIZE_SLACK:
        fits = [unit for factor, unit in _UNITS.items() if 1.0 / SIZE_SLACK <= ratio / factor <= SIZE_SLACK]
        remedy = f": it seems to be in {fits[0]}" if fits else ""
        raise InputError(f"the box is {ratio:.4g} times the true one{remedy}; shapes are in metres")
    if np.linalg.norm(centre - true_centre) > SIZE_SLACK * true_size:
        fits = [name for name in FRAMES if np.linalg.norm(centre - box_of(true_in(name))[0]) < true_size]
        remedy = f": it fits --frame {fits[0]}" if fits else ""
        raise InputError(f"the box is {np.linalg.norm(centre - true_centre):.3g} m from the true one{remedy}")


def _read_volume(path: Path, region: int, prepared: Any, truth: Truth, asked: Asked) -> Scorer:
    """Where `--volume` does not say, values from 0 to 1 are occupancy, of which some are negative distance, negative inside."""
    count = len(prepared["volume_points"])
    predicted = read_array(path, (count,))
    if not np.isfinite(predicted).all():
        raise InputError("the array has values that are not finite")
    is_distance = asked.volume.startswith("sdf")
    if asked.volume == "auto":
        is_distance = bool((predicted < 0.0).any())
    elif asked.volume == "logits":
        predicted = expit(predicted)
    elif asked.volume == "sdf-positive-inside":
        predicted = -predicted
    name = "volume_distance" if is_distance else "volume_occupancy"
    if not is_distance and (predicted.max() > 1.0 or name not in prepared):
        raise InputError(
            f"the values are {predicted.min():.3g} to {predicted.max():.3g}: neither occupancy (0 to 1) nor distance"
        )
    if name not in prepared:
        raise InputError(f"the dataset stores no {name.removeprefix('volume_')} to hold it against")
    true = prepared[name].astype(np.float64)
    if is_distance:
        check_distance(predicted, true)
    return lambda: (score_volume(predicted, true, is_distance), None)


def _read_pose(text: str, region: int, prepared: Any, truth: Truth, asked: Asked) -> Scorer:
    view = truth.pair.input if asked.frame == "input" else truth.view
    T_true = read_matrix(view.regions[region]["T_cam_obj"])
    T = read_pose(text)
    off_m, away_m = math.hypot(*T[:3, 3]), math.hypot(*T_true[:3, 3])  # which does not overflow
    if not 1e-2 < off_m / away_m < 1e2:
        raise InputError(f"t is {off_m / away_m:.4g} times as far as the object: BOP's csv has millimetres")
    return lambda: (score_pose(T, T_true, prepared.vertices, symmetries_of(prepared), view.K), None)


_READERS: Final[Mapping[str, Any]] = {
    "depth": _read_depth,
    "rgb": _read_rgb,
    "shape": _read_shape,
    "volume": _read_volume,
    "pose": _read_pose,
}

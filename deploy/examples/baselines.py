"""Predicts the benchmark's test split by simple means, scores that as `verso score` does, and prints the table by level.

PYTHONPATH=. .venv/bin/python deploy/examples/baselines.py data/benchmark --out data/baselines [--only NAME]

docs/benchmark.md has the rules. Writes OUT/NAME/exact and OUT/NAME/noisy, folders of predictions each with its score, and
OUT/benchmark.csv. Networks are trained where PyTorch is installed, else left out. The same command makes the same numbers.
"""

import argparse
import csv
import dataclasses
import importlib.util
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, product
from pathlib import Path
from typing import Any, Final

import mirror_depth
import numpy as np
import occupancy
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import trimesh
from mirror_depth import pairs_of_split
from numpy.typing import NDArray
from scipy import ndimage

from schemas.dataset.codec import read_matrix
from schemas.dataset.layout import PixelKind
from schemas.errors import InputError, VersoError, plural
from schemas.job.job import Job
from schemas.job.views import DepthNoise, RgbNoise, SensorEffects
from schemas.scene.shape import REGION_FIRST_OBJECT, Mesh
from schemas.scene.view import ROLES
from services.dataset.dataset import Dataset, open_dataset
from services.dataset.pair import Pair
from services.dataset.view import Files
from services.job.record import require_job
from services.score.items import Asked
from services.score.predictions import find_predictions
from services.score.run import score_dataset
from services.score.summary import summarise
from workers.assets.winding import winding_numbers
from workers.geometry.pixels import dequantise_depth, quantise_depth
from workers.geometry.projection import forward_project
from workers.scene.chance import SceneChance
from workers.scene.sensor import sense_depth, sense_rgb
from workers.store.images import encode_png
from workers.store.local import open_store

METRICS: Final = {
    "depth_auc_50mm": "depth, AUC",
    "depth_auc_50mm_hidden": "hidden, AUC",
    "depth_within_2mm": "in 2 mm",
    "depth_within_10mm": "in 10 mm",
    "depth_mae_m": "depth, mm",
    "depth_mae_hidden_m": "hidden, mm",
    "depth_holes": "holes",
    "rgb_ncc": "NCC",
    "rgb_psnr_db": "PSNR, dB",
    "rgb_ssim": "SSIM",
    "shape_chamfer_l1_m": "Chamfer, mm",
    "shape_fscore_2mm": "F, 2 mm",
    "shape_iou": "IoU",
    "volume_iou": "IoU of points",
    "pose_add_m": "ADD, mm",
    "pose_rotation_deg": "turn, °",
}
"""Of the columns of items.parquet, those in the table, and what it calls them."""

COLUMNS: Final = ("name", "job", "scenes", "level", "metric", "value", "low", "high", "items", "seconds")
"""Of benchmark.csv. job: how its digest begins; scenes: of the dataset; items: how many count; seconds: of a core, for a scene's
prediction."""

NOISY: Final = 3
"""The level whose input views are noisy; below it a level is 1 for a scene of one object, else 2."""

DEPTH_NOISE, RGB_NOISE = DepthNoise(), SensorEffects(rgb_noise=RgbNoise())
"""What level 3 has between the scene and the input view."""

SILHOUETTE_PX: Final = 64
"""Side of the window in which masks are compared: an object of 0.25 m has 53 pixels at 2.5 m."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """What is said of a pair, nothing where nothing is said.

    depth_m [H, W], metres, 0 in holes, and rgb [H, W, 3] of the mirror view. By region: shapes in the object's frame, metres,
    values [M] at its stored volume points, poses [4, 4], object to mirror camera.
    """

    depth_m: NDArray | None = None
    rgb: NDArray[np.uint8] | None = None
    shapes: Mapping[int, trimesh.Trimesh] = field(default_factory=dict)
    volumes: Mapping[int, NDArray] = field(default_factory=dict)
    poses: Mapping[int, NDArray] = field(default_factory=dict)


Predictor = Callable[[Pair], Prediction]


def regions_of(pair: Pair) -> list[int]:
    """The ids of a pair's objects."""
    return [region for region in sorted(pair.T_world) if region >= REGION_FIRST_OBJECT]


def mesh_of(pair: Pair, region: int) -> trimesh.Trimesh:
    """An object's closed surface in its own frame."""
    return pair.mesh(region, welded=True).apply_transform(np.linalg.inv(pair.T_world[region]))


# ---------------------------------------------------------------------------------------------------- baselines


def tell_truth(pair: Pair) -> Prediction:
    """What is stored of the mirror view."""
    mirror, regions = pair.mirror, regions_of(pair)
    assert mirror is not None
    return Prediction(
        depth_m=mirror.depth() / mirror.depth_units_per_m,
        rgb=mirror.rgb(),
        shapes={region: mesh_of(pair, region) for region in regions},
        volumes={region: pair.samples(region)["volume_distance"] for region in regions},
        poses={region: read_matrix(mirror.regions[region]["T_cam_obj"]) for region in regions},
    )


def copy_input(pair: Pair) -> Prediction:
    """The input view, as if the mirror camera stood there."""
    return Prediction(pair.input.depth() / pair.input.depth_units_per_m, pair.input.rgb())


def project_input(pair: Pair) -> Prediction:
    """The points of the input view in the mirror view, one pixel each."""
    view, mirror = pair.input, pair.mirror
    assert mirror is not None
    projected = forward_project(view.depth(), view.camera, mirror.camera, 1, view.depth_units_per_m)
    colours = np.concatenate([view.rgb().reshape(-1, 3), np.zeros((1, 3), np.uint8)])  # -1 is a hole
    return Prediction(projected.depth_m, colours[projected.source])


def project_and_fill(pair: Pair) -> Prediction:
    """The same, a hole with what the nearest pixel that is none has."""
    projected = project_input(pair)
    assert projected.depth_m is not None and projected.rgb is not None
    filled = nearest_pixels(projected.depth_m)
    return Prediction(projected.depth_m[filled], projected.rgb[filled])


def nearest_pixels(depth_m: NDArray) -> tuple[NDArray, NDArray]:
    """(row, column), each [H, W], of the nearest pixel that has depth."""
    rows, columns = ndimage.distance_transform_edt(depth_m == 0, return_distances=False, return_indices=True)
    return rows, columns


def stand_plate(pair: Pair) -> Prediction:
    """A plate across the optical axis for each object, at the median depth of its seen points; a pixel has the nearest one's."""
    return spread(pair, lambda points: points * (np.median(points[:, 2]) / points[:, 2:]))


def turn_half(pair: Pair) -> Prediction:
    """The seen points of each object turned by half a turn (mirror_depth.py); a pixel has the nearest one's depth."""
    assert pair.mirror is not None
    up = pair.mirror.T_world_cam[2, :3]
    return spread(pair, lambda points: mirror_depth.half_turn(points, up))


def spread(pair: Pair, guess: Callable[[NDArray], NDArray]) -> Prediction:
    """The nearest depth of what is guessed of each object from its seen points, both [N, 3] in the mirror camera's frame."""
    view, mirror = pair.input, pair.mirror
    assert mirror is not None
    T, depth_m = np.linalg.inv(mirror.T_world_cam) @ view.T_world_cam, np.full(mirror.depth().shape, np.inf)
    seen_m, segment = view.depth_m(), view.segment()
    for region in regions_of(pair):
        points = mirror_depth.unproject(view, seen_m, segment == region)
        if len(points):
            points = guess(mirror_depth.transform(T, points))
            at = np.stack(mirror_depth.pixels_of(mirror, points))
            here = (at >= 0).all(axis=0) & (at < np.array(depth_m.shape)[:, None]).all(axis=0)
            np.minimum.at(depth_m, tuple(at[:, here]), points[here, 2])
    if not np.isfinite(depth_m).any():  # no object is seen
        return project_and_fill(pair)
    depth_m[np.isinf(depth_m)] = 0.0
    return Prediction(depth_m[nearest_pixels(depth_m)])


def find_shapes(dataset: Dataset) -> Predictor:
    """Of the training objects of its category the one whose mask in the input view overlaps most, in the object's frame."""
    masks: dict[str, list[tuple[NDArray[np.bool_], int, int]]] = {}
    for pair in pairs_of_split(dataset, "train"):
        for region in regions_of(pair):
            row = silhouette(pair, region), pair.pose_id, region
            masks.setdefault(pair.input.regions[region]["category"], []).append(row)

    def predict(pair: Pair) -> Prediction:
        shapes = {}
        for region in regions_of(pair):
            mask = silhouette(pair, region)
            known = masks.get(pair.input.regions[region]["category"]) or list(chain(*masks.values()))
            _, pose_id, other = max(known, key=lambda row: (occupancy.iou(row[0], mask), -row[1]))
            shapes[region] = mesh_of(dataset.pair(pose_id), other)
        volumes = {region: inside(pair.samples(region)["volume_points"], mesh) for region, mesh in shapes.items()}
        return Prediction(shapes=shapes, volumes=volumes)

    return predict


def silhouette(pair: Pair, region: int) -> NDArray[np.bool_]:
    """[SILHOUETTE_PX, SILHOUETTE_PX]: an object's mask in the input view about its middle; all False of one that is not seen."""
    places = np.argwhere(pair.input.segment() == region)
    mask = np.zeros((SILHOUETTE_PX, SILHOUETTE_PX), bool)
    if len(places):
        at = places - (places.min(axis=0) + places.max(axis=0)) // 2 + SILHOUETTE_PX // 2
        mask[tuple(at[((at >= 0) & (at < SILHOUETTE_PX)).all(axis=1)].T)] = True
    return mask


def inside(points: NDArray, mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """[M] whether points [M, 3] are in a mesh."""
    shape = Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))
    return np.abs(winding_numbers(points.astype(np.float64), shape)) > 0.5


def train_depth(dataset: Dataset) -> Predictor:
    """The U-Net of train_mirror_depth.py: every object in its crop before the planes of table top and floor."""
    import train_mirror_depth as depth

    fix_numbers()
    net = depth.Net()
    depth.train(net, depth.load(dataset.place), depth.EPOCHS)

    def predict(pair: Pair) -> Prediction:
        depth_m = planes(pair)
        for region in regions_of(pair):
            if (example := mirror_depth.make_example(pair, region)) is not None:
                window = tuple(slice(at, at + n) for at, n in zip(example.corner, mirror_depth.CROP, strict=True))
                depth_m[window] = mirror_depth.nearest(depth_m[window], depth.complete(net, example))
        return Prediction(depth_m)

    return predict


def planes(pair: Pair) -> NDArray[np.float32]:
    """[H, W] depth of table top and floor in the mirror view, metres."""
    assert pair.mirror is not None
    k = pair.mirror.camera.intrinsics
    depth_m = np.zeros((k.height, k.width), np.float32)
    rows, columns = mirror_depth.CROP
    for row, column in product(range(0, k.height, rows), range(0, k.width, columns)):
        here = depth_m[row : row + rows, column : column + columns]
        here[:] = mirror_depth.put_planes(pair, pair.mirror, (row, column))[0][: here.shape[0], : here.shape[1]]
    return depth_m


def train_volume(dataset: Dataset) -> Predictor:
    """The network of train_occupancy.py; nothing is inside an object whose patch leaves the image."""
    import train_mirror_depth as depth
    import train_occupancy as volume

    fix_numbers()
    net = volume.OccupancyNet()
    depth.train(net, volume.load(dataset.place), volume.EPOCHS, volume.loss_of)

    def predict(pair: Pair) -> Prediction:
        examples = {region: occupancy.make_example(pair, region, uniform=False) for region in regions_of(pair)}
        none = {region: np.zeros(len(pair.samples(region)["volume_points"]), bool) for region in examples}
        answers = {region: volume.answer(net, example) for region, example in examples.items() if example}
        return Prediction(volumes=none | answers)

    return predict


def fix_numbers() -> None:
    """The same numbers from PyTorch each time: one seed, one thread, no algorithm whose order of sums varies."""
    import torch

    torch.manual_seed(1)
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)


BASELINES: Final[Mapping[str, Callable[[Dataset], Predictor]]] = {
    "truth": lambda dataset: tell_truth,
    "input copied": lambda dataset: copy_input,
    "projected": lambda dataset: project_input,
    "projected and filled": lambda dataset: project_and_fill,
    "flat plate": lambda dataset: stand_plate,
    "half turn": lambda dataset: turn_half,
    "nearest training shape": find_shapes,
    "mirror-depth network": train_depth,
    "occupancy network": train_volume,
}
"""What makes a predictor of a dataset, by name."""

NETWORKS: Final = ("mirror-depth network", "occupancy network")
"""Those that PyTorch trains."""


# ---------------------------------------------------------------------------------------------------- predictions and scores


def write(folder: Path, pair: Pair, said: Prediction) -> None:
    """Puts a prediction into a folder as `verso score` reads it."""
    assert pair.mirror is not None
    name, files = f"{pair.mirror.pose_id:05d}", dict[str, Any]()
    if said.depth_m is not None:
        units = np.rint(said.depth_m * pair.mirror.depth_units_per_m)
        files[f"depth/{name}.png"] = encode_png(np.clip(units, 0, 65535).astype(np.uint16))
    if said.rgb is not None:
        files[f"rgb/{name}.png"] = encode_png(said.rgb)
    for region in regions_of(pair):
        stem = name + (f"obj{region - REGION_FIRST_OBJECT}" if region > REGION_FIRST_OBJECT else "")
        if region in said.shapes:
            files[f"shape/{stem}.ply"] = trimesh.exchange.ply.export_ply(said.shapes[region])
        if region in said.volumes:
            (folder / "volume").mkdir(parents=True, exist_ok=True)
            np.save(folder / "volume" / f"{stem}.npy", said.volumes[region])
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    if said.poses:
        table = folder / "poses.csv"
        lines = [] if table.exists() else ["scene_id,im_id,obj_id,R,t\n"]
        for region, T in said.poses.items():
            R, t = (" ".join(map(repr, part.ravel().tolist())) for part in (T[:3, :3], 1e3 * T[:3, 3]))
            lines.append(f"{pair.scene_id},{pair.mirror.pose_id},{region},{R},{t}\n")
        with table.open("a") as file:
            file.writelines(lines)


class SensedFiles:
    """The files of a pair, some images of which are others: by path."""

    def __init__(self, files: Files, images: Mapping[str, bytes]) -> None:
        self._files, self._images = files, images
        self.patch, self.mesh, self.samples = files.patch, files.mesh, files.samples

    def image(self, path: str) -> bytes:
        """The bytes of an image."""
        return self._images[path] if path in self._images else self._files.image(path)


def sense_input(pair: Pair, job: Job) -> Pair:
    """The pair with the input view, patches included, that the same job with this noise stores: the same pixels."""
    view = pair.input
    chance, number = SceneChance(job.seed, pair.scene_id), pair.pose_id // 2 % job.pairs_per_scene

    def generator(name: str) -> np.random.Generator:
        return chance.sensor_stream(name, number, ROLES.index("input"))

    exact_m = dequantise_depth(view.depth(), job.images)
    sensed_m = sense_depth(exact_m, view.segment(), view.camera, DEPTH_NOISE, generator("depth_noise"))
    sensed: dict[PixelKind, Any] = {
        "depth": quantise_depth(sensed_m, job.images),
        "rgb": sense_rgb(view.rgb(), view.camera.intrinsics, RGB_NOISE, generator),
    }
    crops = [patch for region in regions_of(pair) if (patch := view.patch(region)) is not None]
    images = {}
    for pixels, kind in product([view, *crops], sensed):
        k, moved = view.camera.intrinsics, pixels.camera.intrinsics
        top, left = round(k.cy - moved.cy), round(k.cx - moved.cx)
        images[pixels.images[kind]] = encode_png(sensed[kind][top : top + moved.height, left : left + moved.width])
    changed = dataclasses.replace(view, _files=SensedFiles(view._files, images))
    return dataclasses.replace(pair, views={**pair.views, "input": changed})


def score(dataset: Dataset, folder: Path) -> pa.Table:
    """The items of predictions, as `verso score` writes them."""
    given, store = find_predictions(folder), open_store(dataset.place)
    return pq.read_table(score_dataset(store, given, Asked(given.kinds, split="test"), folder / "score"))


def run(name: str, dataset: Dataset, out: Path) -> list[dict[str, Any]]:
    """The lines of benchmark.csv of a baseline, whose predictions are made first, or of predictions of one's own in OUT/NAME."""
    head = {"name": name, "job": require_job(open_store(dataset.place)).digest[:12], "scenes": dataset.job.scenes}
    predict, rows = BASELINES[name](dataset) if name in BASELINES else None, list[dict[str, Any]]()
    for sensor in ("exact", "noisy"):
        folder, levels, seconds = out / name.replace(" ", "_") / sensor, dict[int, int](), 0.0
        if predict is not None:
            (folder / "poses.csv").unlink(missing_ok=True)
        for pair in pairs_of_split(dataset, "test"):
            levels[pair.scene_id] = NOISY if sensor == "noisy" else 1 if len(regions_of(pair)) == 1 else 2
            if predict is not None:
                seen = sense_input(pair, dataset.job) if sensor == "noisy" else pair
                begun = time.process_time()
                said = predict(seen)
                seconds += time.process_time() - begun
                write(folder, pair, said)
        each_s = f"{seconds / max(len(levels), 1):.2g}" if predict is not None else ""
        rows += [{**head, **row, "seconds": each_s} for row in rows_of(score(dataset, folder), levels, folder)]
    return rows


def rows_of(table: pa.Table, levels: Mapping[int, int], folder: Path) -> Iterator[dict[str, Any]]:
    """Level, metric and figure, for each; levels: by scene id. Raises InputError where items are missing."""
    for level in sorted(set(levels.values())):
        chosen = pa.array([scene for scene in levels if levels[scene] == level], pa.int64())
        items = table.filter(pc.is_in(table["scene_id"], chosen))
        if count := pc.sum(pc.equal(items["status"], "missing")).as_py():
            raise InputError(
                f"{folder} misses {plural(count, 'item')} of test scenes: predict every one, if only as empty"
            )
        figures = summarise(items)["metrics"]
        for metric in (name for name in METRICS if name in figures and figures[name]["items"]):
            # Five digits are more than an interval leaves meaning to
            values = {key: figures[metric][key] for key in ("value", "low", "high", "items")}
            words = {key: "" if value is None else f"{value:.5g}" for key, value in values.items()}
            yield {"level": level, "metric": metric, **words}


# ---------------------------------------------------------------------------------------------------- table


def table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The lines of benchmark.csv as Markdown: a value and, in brackets, its interval; lengths in millimetres; and the seconds."""
    there = [metric for metric in METRICS if any(row["metric"] == metric for row in rows)]
    lines = [["", "level", *(METRICS[metric] for metric in there), "s"]]
    lines.append(["---"] * len(lines[0]))
    groups = dict[tuple[str, str], dict[str, Mapping[str, Any]]]()
    for row in rows:
        groups.setdefault((row["name"], str(row["level"])), {})[row["metric"]] = row
    for names, group in groups.items():
        cells = [cell(metric, group[metric]) if metric in group else "" for metric in there]
        lines.append([*names, *cells, next(iter(group.values()))["seconds"]])
    return "\n".join(f"|{'|'.join(line)}|" for line in lines)


def cell(metric: str, row: Mapping[str, Any]) -> str:
    """`3.1 (2.9–3.4)`; the value alone where there is no interval, or none to speak of."""
    scale = 1e3 if metric.endswith("_m") else 1.0
    value, low, high = (scale * float(row[key] or "nan") for key in ("value", "low", "high"))
    words = [f"{figure:.0f}" if abs(figure) >= 1e3 else f"{figure:.3g}" for figure in (value, low, high)]
    return f"{words[0]} ({words[1]}–{words[2]})" if low < high else words[0]


def read_options() -> argparse.Namespace:
    """The words of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("place", metavar="DATASET", help="of deploy/jobs/benchmark.yaml")
    parser.add_argument("--out", type=Path, required=True, help="folder for predictions, scores and benchmark.csv")
    parser.add_argument("--only", action="append", help="a baseline, or a folder of OUT with your own predictions")
    return parser.parse_args()


def main() -> None:
    """Every baseline that can be made here: predict, score, print."""
    options = read_options()
    dataset = open_dataset(options.place)
    rows: list[dict[str, Any]] = []
    for name in options.only or BASELINES:
        if name in NETWORKS and importlib.util.find_spec("torch") is None:
            print(f"{name}: left out, PyTorch is not installed")
            continue
        rows += run(name, dataset, options.out)
        print(f"{name}: {rows[-1]['seconds']} s a scene", flush=True)
    with (options.out / "benchmark.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(table_of(rows))


if __name__ == "__main__":
    try:
        main()
    except VersoError as error:
        sys.exit(f"baselines: {error}")

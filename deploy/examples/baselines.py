"""Predicts the benchmark's levels by simple means, scores that as `verso score --level` does, and prints the table.

PYTHONPATH=. .venv/bin/python deploy/examples/baselines.py data/benchmark --out data/baselines [--only NAME]

docs/benchmark.md has the rules. Writes OUT/NAME/exact and OUT/NAME/noisy, predictions with their scores by level, and
OUT/benchmark.csv of all that OUT has. Networks are trained where PyTorch is installed, else left out. The same command makes the
same numbers.
"""

import argparse
import csv
import dataclasses
import importlib.util
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, Final

import guesses
import numpy as np
import occupancy
import pyarrow as pa
import pyarrow.parquet as pq
import trimesh
from guesses import Prediction, Predictor, mesh_of, regions_of, write
from mirror_depth import pairs_of_split
from numpy.typing import NDArray

from schemas.dataset.layout import PixelKind
from schemas.errors import InputError, VersoError, plural
from schemas.job.job import Job
from schemas.job.views import DepthNoise, RgbNoise, SensorEffects
from schemas.scene.shape import Mesh
from schemas.scene.view import ROLES
from services.dataset.dataset import Dataset, open_dataset
from services.dataset.pair import Pair
from services.dataset.view import Files
from services.job.record import require_job
from services.score.items import LEVELS, Asked
from services.score.leaderboard import compare_all
from services.score.predictions import find_predictions
from services.score.run import ITEMS_FILE, score_dataset
from services.score.summary import items_of, summarise
from workers.assets.winding import winding_numbers
from workers.geometry.pixels import dequantise_depth, quantise_depth
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
"""Of the columns of items.parquet, those of benchmark.csv, and what the table calls them."""

SHOWN: Final = ("depth_auc_50mm", "depth_auc_50mm_hidden", "depth_within_10mm", "depth_mae_m", "depth_holes", "rgb_ncc",
    "shape_chamfer_l1_m", "volume_iou")  # fmt: skip
FIRST: Final = ("depth_auc_50mm", "shape_chamfer_l1_m", "volume_iou")
"""Those of the table, and of these the first of each kind, which have their intervals there."""

COLUMNS: Final = ("name", "job", "scenes", "level", "metric", "value", "low", "high", "items", "seconds", "plate")
"""Of benchmark.csv. job: how its digest begins; scenes: of the dataset; items: how many count; seconds: of a core, for a scene's
prediction; plate: whether that is surely `better` or `worse` than the flat plate (services/score/leaderboard.py)."""

NOISY: Final = "3"
"""The level whose input views are noisy."""

OF_MASKS: Final = ("nearest training shape",)
"""Baselines that look at masks alone, which noise does not change: they have no such level."""

PLATE: Final = "flat plate"
TOLD_APART: Final = ("depth_auc_50mm", "depth_auc_50mm_hidden")
"""What baselines are told apart from the plate by."""

DEPTH_NOISE, RGB_NOISE = DepthNoise(), SensorEffects(rgb_noise=RgbNoise())
"""What level 3 has between the scene and the input view."""

SILHOUETTE_PX: Final = 64
"""Side of the window in which masks are compared: an object of 0.25 m has 53 pixels at 2.5 m."""


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


def train_depth(dataset: Dataset, noise: bool = False) -> Predictor:
    """The U-Net of train_mirror_depth.py; noise: it learns from each pair twice, as stored and with level 3's input view."""
    import train_mirror_depth as depth

    fix_numbers()
    net = depth.Net()
    senses = [partial(sense_input, job=dataset.job)] if noise else []
    depth.train(net, depth.load(dataset.place, *senses), depth.EPOCHS)
    return depth.predictor(net)


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
    "truth": lambda dataset: guesses.tell_truth,
    "projected": lambda dataset: guesses.project_input,
    "projected and filled": lambda dataset: guesses.project_and_fill,
    "flat plate": lambda dataset: guesses.stand_plate,
    "half turn": lambda dataset: guesses.turn_half,
    "symmetry": lambda dataset: guesses.complete_by_symmetry,
    "nearest training shape": find_shapes,
    "mirror-depth network": train_depth,
    "mirror-depth network with noise": partial(train_depth, noise=True),
    "occupancy network": train_volume,
}
"""What makes a predictor of a dataset, by name."""

NETWORKS: Final = ("mirror-depth network", "mirror-depth network with noise", "occupancy network")
"""Those that PyTorch trains."""


# ---------------------------------------------------------------------------------------------------- predictions and scores


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


def folder_of(out: Path, name: str, level: str) -> Path:
    """Of the predictions of a level."""
    return out / name.replace(" ", "_") / ("noisy" if level == NOISY else "exact")


def score(dataset: Dataset, folder: Path, level: str) -> pa.Table:
    """The items of a level, as `verso score --level` writes them. Raises InputError where one is missing."""
    given, store = find_predictions(folder), open_store(dataset.place)
    asked = Asked(given.kinds, level=level)
    table = items_of(pq.read_table(score_dataset(store, given, asked, folder / f"score{level}")))
    if count := sum(status == "missing" for status in table["status"].to_pylist()):
        raise InputError(
            f"{folder} misses {plural(count, 'item')} of level {level}: predict every one, if only as empty"
        )
    return table


def run(name: str, dataset: Dataset, out: Path) -> list[dict[str, Any]]:
    """The lines of benchmark.csv of a baseline, whose predictions are made first, or of predictions of one's own in OUT/NAME."""
    head = {"name": name, "job": require_job(open_store(dataset.place)).digest[:12], "scenes": dataset.job.scenes}
    predict, rows = BASELINES[name](dataset) if name in BASELINES else None, list[dict[str, Any]]()
    levels = [level for level in LEVELS if level != NOISY or name not in OF_MASKS]
    seconds = {level: list[float]() for level in levels}
    for level in levels if predict is not None else ():
        split, has = LEVELS[level]
        folder = folder_of(out, name, level)
        if level in ("1", NOISY):
            (folder / "poses.csv").unlink(missing_ok=True)
        for pair in pairs_of_split(dataset, split):
            if has(len(regions_of(pair))):
                given = sense_input(pair, dataset.job) if level == NOISY else pair
                begun = time.process_time()
                said = predict(given)
                seconds[level].append(time.process_time() - begun)
                write(folder, pair, said)
    for level in levels:
        items = score(dataset, folder_of(out, name, level), level)
        figures = summarise(items)["metrics"] if items.num_rows else {}
        each_s = f"{np.mean(seconds[level]):.2g}" if seconds[level] else ""
        for metric in (metric for metric in METRICS if metric in figures and figures[metric]["items"]):
            # Five digits are more than an interval leaves meaning to
            values = {key: figures[metric][key] for key in ("value", "low", "high", "items")}
            words = {key: "" if value is None else f"{value:.5g}" for key, value in values.items()}
            rows.append({**head, "level": level, "metric": metric, **words, "seconds": each_s, "plate": ""})
    (out / name.replace(" ", "_") / "rows.json").write_text(json.dumps(rows))
    return rows


def tell_apart(rows: Sequence[dict[str, Any]], out: Path) -> None:
    """Says in rows of `TOLD_APART` whether each is surely better or worse than the plate's, by the items that OUT has."""
    for level in LEVELS:
        names = dict.fromkeys(row["name"] for row in rows if row["level"] == level and row["metric"] in TOLD_APART)
        if PLATE not in names:
            continue
        items = {name: pq.read_table(folder_of(out, name, level) / f"score{level}" / ITEMS_FILE) for name in names}
        words = dict[tuple[str, str], str]()
        for verdict in compare_all(items, TOLD_APART):
            a, b, better = verdict["a"], verdict["b"], verdict["better"]
            if better and PLATE in (a, b):
                words[b if a == PLATE else a, verdict["metric"]] = "worse" if better == PLATE else "better"
        for row in rows:
            if row["level"] == level and row["metric"] in TOLD_APART:
                row["plate"] = words.get((row["name"], row["metric"]), "")


# ---------------------------------------------------------------------------------------------------- table


def table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The lines of benchmark.csv as Markdown: a value and, in brackets, its interval; lengths in millimetres; and the seconds."""
    there = [metric for metric in SHOWN if any(row["metric"] == metric for row in rows)]
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
    """`3.1 (2.9–3.4) +`, better than the plate: with the interval of `FIRST` where there is one to speak of; else the value."""
    scale = 1e3 if metric.endswith("_m") else 1.0
    value, low, high = (scale * float(row[key] or "nan") for key in ("value", "low", "high"))
    words = [f"{figure:.0f}" if abs(figure) >= 1e3 else f"{figure:.3g}" for figure in (value, low, high)]
    mark = {"better": " +", "worse": " -"}.get(row["plate"], "")
    return f"{words[0]} ({words[1]}–{words[2]}){mark}" if metric in FIRST and low < high else words[0] + mark


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
    for name in options.only or BASELINES:
        if name in NETWORKS and importlib.util.find_spec("torch") is None:
            print(f"{name}: left out, PyTorch is not installed")
            continue
        print(f"{name}: {run(name, dataset, options.out)[-1]['seconds']} s a scene", flush=True)
    ours = [options.out / name.replace(" ", "_") / "rows.json" for name in BASELINES]
    others = sorted({*options.out.glob("*/rows.json")} - {*ours})
    rows = [row for path in (*ours, *others) if path.is_file() for row in json.loads(path.read_text())]
    tell_apart(rows, options.out)
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

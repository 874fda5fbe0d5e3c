"""Names the shapes of train, val and test so that none of two splits are alike, and checks it in a finished dataset.

PYTHONPATH=. .venv/bin/python deploy/examples/split_by_distance.py make deploy/jobs/benchmark.yaml [--gate-mm 2]
PYTHONPATH=. .venv/bin/python deploy/examples/split_by_distance.py check data/benchmark [--gate-mm 2] [--csv FILE]

Alike are shapes of one category whose Chamfer distance, as `verso score` has it (the mean of both directions), is below the gate.
`make` prints what stands below `assets.split.named` of the job: of 20 orders in which shapes are taken the one whose smallest
split is largest. A shape that is like some of two splits is in none. `check` measures stored shapes: of each one of test and
unseen the nearest of train, with a histogram; it ends with 1 where one of test is below the gate.
"""

import argparse
import csv
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.dataset.layout import asset_path
from schemas.job.assets import CATEGORIES, TABLE, ProceduralSource, instance_id
from schemas.scene.shape import Mesh
from services.dataset.dataset import open_dataset
from services.job.job_file import load_job
from services.score.shape import draw_points
from workers.assets.builtin.make import make_asset
from workers.geometry.distance import distance_to_mesh

POINTS: Final = 1000
"""Drawn on each shape: the mean of their distances is then known to 2 %."""

ORDERS: Final = 20
SHARES: Final = {"train": 0.5, "val": 0.06, "test": 0.44}
BINS_MM: Final = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, np.inf)

Sampled = tuple[NDArray[np.float64], Mesh]
"""Points [POINTS, 3] of a surface, and the surface, object frame, metres."""


def sample(vertices: NDArray, faces: NDArray) -> Sampled:
    """Points drawn uniformly on a surface, the same each time."""
    mesh = Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32))
    return draw_points(mesh, np.random.default_rng(1), POINTS)[0], mesh


def chamfer_mm(a: Sampled, b: Sampled) -> float:
    """Mean of both directions' mean distances, millimetres."""
    return 500.0 * float(distance_to_mesh(a[0], b[1])[0].mean() + distance_to_mesh(b[0], a[1])[0].mean())


def make_split(apart_mm: NDArray[np.float64], gate_mm: float, order: Sequence[int]) -> list[str]:
    """The split of each shape, empty for none: taken in an order, a shape is in the split of those that are like it.

    apart_mm [N, N]: Chamfer distances. One that is like none goes where the shares lack most.
    """
    splits = [""] * len(order)
    for shape in order:
        alike = {splits[other] for other in np.flatnonzero(apart_mm[shape] < gate_mm) if splits[other]}
        counts = {name: splits.count(name) for name in SHARES}
        lacking = max(SHARES, key=lambda name: SHARES[name] * (sum(counts.values()) + 1) - counts[name])
        splits[shape] = lacking if not alike else alike.pop() if len(alike) == 1 else ""
    return splits


def make(job_file: Path, gate_mm: float) -> None:
    """Prints the named instances of every built-in category of the job that is not unseen."""
    job = load_job(job_file)
    source = next(one for one in job.assets.objects if isinstance(one, ProceduralSource))
    named = defaultdict[str, list[str]](list)
    for category in sorted({*job.categories} & {*CATEGORIES}):
        names = [instance_id(category, source.seed, number) for number in range(source.instances)]
        if job.assets.split.of(names[0]) == "unseen":
            continue
        assets = [make_asset(category, source, number, job.assets.density_kg_m3) for number in range(source.instances)]
        sampled = [sample(asset.shape.vertices, asset.shape.faces) for asset in assets]
        apart_mm = np.full((len(names), len(names)), np.inf)
        for a, b in zip(*np.tril_indices(len(names), -1), strict=True):
            apart_mm[a, b] = apart_mm[b, a] = chamfer_mm(sampled[a], sampled[b])
        tried = [
            make_split(apart_mm, gate_mm, np.random.default_rng(seed).permutation(len(names)).tolist())
            for seed in range(ORDERS)
        ]
        best = max(tried, key=lambda splits: min(splits.count(name) / share for name, share in SHARES.items()))
        for name, split in zip(names, best, strict=True):
            named[split].append(name)
        print(
            f"# {category}: {', '.join(f'{best.count(split)} {split}' for split in SHARES)}, {best.count('')} in none"
        )
    for split in SHARES:
        print(f"{split}: [{', '.join(named[split])}]")


def check(place: str, gate_mm: float, table: Path | None) -> bool:
    """Whether no shape of test is nearer to one of train and its category than the gate; prints, and writes a row a shape."""
    rows = open_dataset(place).table("assets").to_table(columns=["instance_id", "category", "split"]).to_pylist()
    shapes: dict[str, tuple[Mapping[str, str], Sampled]] = {}
    for row in rows:
        name, file = row["instance_id"], Path(place) / asset_path(row["category"], row["instance_id"])
        if row["category"] != TABLE and row["split"] in ("train", "test", "unseen") and name not in shapes:
            mesh = trimesh.load(file, force="mesh")
            shapes[name] = row, sample(mesh.vertices, mesh.faces)
    train = [(row, sampled) for row, sampled in shapes.values() if row["split"] == "train"]
    lines = []
    for row, sampled in shapes.values():
        others = [one for other, one in train if row["split"] == "unseen" or other["category"] == row["category"]]
        if row["split"] != "train" and others:
            nearest = min(chamfer_mm(sampled, other) for other in others)
            lines.append((row["split"], row["category"], row["instance_id"], round(nearest, 3)))
    for split in ("test", "unseen"):
        apart_mm = np.array([line[3] for line in lines if line[0] == split])
        if len(apart_mm):
            counts = np.histogram(apart_mm, BINS_MM)[0]
            bins = (
                f"{low:g} to {high:g}: {n}" for low, high, n in zip(BINS_MM, BINS_MM[1:], counts, strict=False) if n
            )
            print(f"{split}: {len(apart_mm)} shapes, mm to the nearest of train: {', '.join(bins)}")
            print(f"{split}: least {apart_mm.min():.2f}, median {np.median(apart_mm):.2f} mm")
    if table is not None:
        with table.open("w", newline="") as file:
            csv.writer(file).writerows([("split", "category", "instance_id", "nearest_mm"), *sorted(lines)])
    return all(line[3] >= gate_mm for line in lines if line[0] == "test")


def main() -> int:
    """Makes or checks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("make", "check"))
    parser.add_argument("place", metavar="JOB|DATASET")
    parser.add_argument("--gate-mm", type=float, default=2.0)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    if options.what == "make":
        make(Path(options.place), options.gate_mm)
        return 0
    return 0 if check(options.place, options.gate_mm, options.csv) else 1


if __name__ == "__main__":
    sys.exit(main())

"""Predictions of a stranger: mutants of every format, what is no file, and what takes too much memory or time.

Each is scored or refused in a line, mutants within two seconds and a gigabyte, in silence, and what is beside it is scored.
"""

import io
import json
import os
import random
import re
import shutil
import struct
import time
from functools import cache

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

from schemas.errors import InputError
from services.cli.main import main
from services.dataset.dataset import open_dataset
from services.score import run as module
from services.score.items import Asked, score_pair
from services.score.predictions import find_predictions
from services.score.run import _table
from services.score.summary import summarise
from tests.datasets import make_dataset
from tests.kit.tiers import first_of
from tests.mutations import mutated_bytes, places
from tests.workers.door.mutants import CHANGES, VALUES, bomb, number, repeat, word
from tests.workers.door.oracles import glb
from workers.pool import Limits, run_pool

MOST_CPU_S, MOST_MIB = 2.0, 1024
"""Of one mutant, read and scored."""

FLOATS = [float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 1e-320, 1e200, -1.0, 0.0]


def values(dice, data):
    """Some of the doubles behind a header replaced by extremes."""
    for at in dice.choices(range(128, max(len(data) - 8, 129), 8), k=3):
        data = data[:at] + struct.pack("<d", dice.choice(FLOATS)) + data[at + 8 :]
    return data


def header(dice, data):
    """Another shape, type or order in the header of an array."""
    new = dice.choice([b"1" * 18, b"-1", b"0", b"(1,)", b"4294967296", b"None", b"'", b"(" * 60])
    old = dice.choice([b"120", b"160", b"'<f8'", b"<f8", b"False", b"shape", b"}"])
    return data.replace(old, new, 1)


def value(dice, data):
    """One value of a binary glTF's tree replaced: `tree` also multiplies what it has multiplied, to gigabytes."""
    try:
        length = struct.unpack_from("<I", data, 12)[0]
        root = json.loads(data[20 : 20 + length])
        holder, key = dice.choice([*places(root)])
        holder[key] = dice.choice(VALUES)
        return glb(root, data[28 + length :])
    except (struct.error, ValueError, IndexError, RecursionError):
        return mutated_bytes(dice, data)


ARRAY = (word, values, values, header, header, number)
FORMATS = {
    **{f"depth .{kind}": changes for kind, changes in {"png": (word, bomb), "npy": ARRAY}.items()},
    "rgb .png": (word, bomb),
    **{f"shape .{kind}": CHANGES[kind] for kind in ("ply", "obj")},
    "shape .glb": (word, value, value, value),
    "shape .npz": (word, values),
    "volume .npy": ARRAY,
    "pose .csv": (number, number, repeat),
}
"""What is done to each format, beside `mutated_bytes`."""


@cache
def pair_of(root):
    """(the first pair of the dataset, its job, what is true of it by format)."""
    dataset = open_dataset(root)
    pair = next(iter(dataset.pairs()))
    depth, mesh = pair.mirror.depth(), pair.mesh(3, welded=True)
    T_obj_world = np.linalg.inv(pair.T_world[3])
    vertices = np.asarray(mesh.vertices) @ T_obj_world[:3, :3].T + T_obj_world[:3, 3]
    mesh = trimesh.Trimesh(vertices, mesh.faces, process=False)
    T = np.linalg.inv(pair.mirror.T_world_cam) @ pair.T_world[3]
    R, t = (" ".join(map(str, part.ravel())) for part in (T[:3, :3], 1e3 * T[:3, 3]))

    def packed(save, array):
        file = io.BytesIO()
        save(file, array)
        return file.getvalue()

    truth = {
        "depth .png": cv2.imencode(".png", depth)[1].tobytes(),
        "depth .npy": packed(np.save, depth / pair.mirror.depth_units_per_m),
        "rgb .png": cv2.imencode(".png", pair.mirror.rgb()[..., ::-1])[1].tobytes(),
        "shape .npz": packed(lambda file, points: np.savez(file, points=points), vertices),
        "volume .npy": packed(np.save, pair.samples()["volume_distance"].astype(np.float64)),
        "pose .csv": f"scene_id,im_id,obj_id,R,t\n{pair.scene_id},{pair.mirror.pose_id},3,{R},{t}\n".encode(),
        **{f"shape .{kind}": _bytes(mesh.export(file_type=kind)) for kind in ("ply", "obj", "glb")},
    }
    return pair, dataset.job, truth


def _bytes(data):
    return data.encode() if isinstance(data, str) else data


def mutant(data, kind, index):
    """One to three changes of the bytes, the same for the same number."""
    dice = random.Random(f"{kind} {index}")
    for _ in range(dice.randint(1, 3)):
        if len(data) > 1_000_000:  # changes that repeat would repeat what is repeated
            break
        data = dice.choice([*FORMATS[kind], mutated_bytes])(dice, data or b"\0")[:8_000_000]
    return data


def score_mutant(item):
    """Statuses and reasons of what a folder with one mutant has, and processor seconds, as JSON."""
    root, kind, folder = item
    pair, job, _ = pair_of(root)
    start = time.process_time()
    try:
        given = find_predictions(folder)
    except InputError as error:  # of a table of poses without a row
        return json.dumps([[], [str(error)], 0.0]).encode()
    rows = score_pair(pair, folder, given.names, Asked((kind.partition(" ")[0],), samples=300), job)
    seconds = time.process_time() - start
    summarise(_table(rows))
    reasons = [row["reason"] for row in rows if row["status"] == "refused"] + [why for _, why in given.strays]
    return json.dumps([[row["status"] for row in rows], reasons, seconds]).encode()


def write_mutants(root, kind, count, folder):
    """What is asked of `score_mutant`, one after the other; making a mutant may take more memory than reading it."""
    pair, _, truth = pair_of(root)
    modality, suffix = kind.split(" ")
    name = "poses.csv" if modality == "pose" else f"{modality}/{pair.mirror.pose_id:05d}{suffix}"
    for index in range(count):
        (folder / str(index) / name).parent.mkdir(parents=True)
        (folder / str(index) / name).write_bytes(mutant(truth[kind], kind, index))
        yield root, kind, folder / str(index)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Five scenes with samples of their shapes."""
    targets = {"shape": ["volume"], "points": 500}
    return str(make_dataset(tmp_path_factory.mktemp("hostile"), scenes=5, categories=["box"], targets=targets)[0].root)


@pytest.mark.parametrize(
    "count",
    [
        30,
        pytest.param(1000, marks=(pytest.mark.slow, pytest.mark.timeout(3000))),
    ],
)
@pytest.mark.parametrize("kind", first_of(FORMATS, 0, 6))
def test_mutants_are_scored_or_refused_in_a_line_and_nothing_else(root, kind, count, tmp_path, capfd):
    ends, seconds = {"ok": 0, "refused": 0, "missing": 0}, []
    items = write_mutants(root, kind, count, tmp_path)
    limits = Limits(memory_mb=MOST_MIB, cpu_s=30.0)
    for (_, _, folder), answer in run_pool(score_mutant, items, limits=limits, processes=2, quiet=False):
        assert isinstance(answer, bytes), (folder, answer)
        statuses, reasons, cpu_s = json.loads(answer)
        assert cpu_s < MOST_CPU_S, (folder, cpu_s)
        assert all(reason and reason.isprintable() and len(reason) < 700 for reason in reasons), (folder, reasons)
        assert "refused" not in statuses or reasons
        for status in statuses:
            ends[status] += 1
        seconds.append(cpu_s)
        shutil.rmtree(folder)
    assert len(seconds) == count and ends["ok"] + ends["missing"] < count
    assert capfd.readouterr().err == ""


def score_folder(root, folder):
    """(exit status, status and reason of each item by kind and pose id; of one without a pose by kind and None)."""
    status = main(["score", root, str(folder)])
    rows = pq.read_table(folder / "score" / "items.parquet").to_pylist()
    return status, {(row["kind"], row["pose_id"]): (row["status"], row["reason"]) for row in rows}


def swell(path):
    path.touch()
    os.truncate(path, 6 << 30)


IRREGULAR = {
    "a pipe": (os.mkfifo, "is a pipe"),
    "a folder": (os.mkdir, "is a folder"),
    "a link to a device": (lambda path: path.symlink_to("/dev/zero"), "is a link out of"),
    "a link to a file elsewhere": (lambda path: path.symlink_to(path.parents[2] / "elsewhere"), "is a link out of"),
    "a link to nothing": (lambda path: path.symlink_to("nowhere"), "No such file"),
    "a link to itself": (lambda path: path.symlink_to(path.name), "symbolic links"),
    "six gigabytes": (swell, "no more are read"),
}
"""How it is made, and what is said of it."""


@pytest.mark.parametrize("what", first_of(IRREGULAR, 1))
def test_what_is_no_file_of_the_folder_is_refused_in_every_format(root, what, tmp_path):
    make, told = IRREGULAR[what]
    pair, _, truth = pair_of(root)
    folder, kinds = tmp_path / "given", {kind.partition(" ")[0] for kind in FORMATS} - {"pose"}
    waiting = {kind: [other.mirror.pose_id for other in open_dataset(root).pairs()][1:] for kind in kinds}
    (folder / "kept").mkdir(parents=True)
    (tmp_path / "elsewhere").write_bytes(truth["depth .npy"])
    expected = {}
    for name in FORMATS:
        kind, suffix = name.split(" ")
        if kind == "pose":
            make(folder / "poses.csv")
            continue
        (folder / kind).mkdir(exist_ok=True)
        expected[kind, waiting[kind][0]] = "refused"
        make(folder / kind / f"{waiting[kind].pop(0)}{suffix}")
    for kind, suffix in {
        "depth": ".npy",
        "rgb": ".png",
        "shape": ".ply",
        "volume": ".npy",
    }.items():  # links, but inside
        (folder / "kept" / kind).write_bytes(truth[f"{kind} {suffix}"])
        (folder / kind / f"{pair.mirror.pose_id}{suffix}").symlink_to(f"../kept/{kind}")
        expected[kind, pair.mirror.pose_id] = "ok"
    status, items = score_folder(root, folder)
    assert (status, items["pose", None][0]) == (1, "unknown")
    assert {key: end for key, (end, _) in items.items() if end in ("ok", "refused")} == expected
    reasons = [why for end, why in items.values() if end in ("refused", "unknown")]
    assert len(reasons) == len(FORMATS) and all(told in why and why.isprintable() for why in reasons)


def slow(mesh):
    """An open sheet of 700,000 faces about a box."""
    size, (low, high) = 600, mesh.bounds
    y, x = np.indices((size, size)).reshape(2, -1) / (size - 1)
    vertices = low + (high - low) * np.column_stack([x, y, 0.2 * np.sin(9.0 * x)])
    corner = np.arange(size * size).reshape(size, size)
    a, b, c, d = (corner[i : size - 1 + i, j : size - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([b, d, c])])
    return ".ply", trimesh.Trimesh(vertices, faces, process=False).export(file_type="ply")


def hungry(mesh):
    """A mesh with nine million texture coordinates, which no count limits."""
    return ".obj", mesh.export(file_type="obj").encode() + b"\nvt 0 0" * 9_000_000


@pytest.mark.minute
@pytest.mark.parametrize(
    ("limit", "most", "spoil", "told"),
    [
        ("MOST_MIB", 1024, hungry, "more (memory than there is|than 1024 MiB of memory): make it smaller"),
        ("MOST_CPU_S", 1.5, slow, "takes more than 1.5 s of processor time: make it smaller"),
    ],
)
def test_an_item_beyond_a_limit_is_refused_and_all_others_are_scored(
    root, limit, most, spoil, told, tmp_path, monkeypatch
):
    """Also what is predicted of the same pose, and whatever the item is: within the limits it would be scored."""
    deadly = 5
    for kind in ("depth", "shape"):
        (tmp_path / kind).mkdir()
    for pair in open_dataset(root).pairs():
        pose_id, mesh = pair.mirror.pose_id, pair.mesh(3, welded=True).apply_transform(np.linalg.inv(pair.T_world[3]))
        np.save(tmp_path / "depth" / f"{pose_id}.npy", pair.mirror.depth() / pair.mirror.depth_units_per_m)
        suffix, data = spoil(mesh) if pose_id == deadly else (".ply", mesh.export(file_type="ply"))
        (tmp_path / "shape" / f"{pose_id}{suffix}").write_bytes(data)
    monkeypatch.setattr(module, limit, most)
    status, items = score_folder(root, tmp_path)
    assert status == 1 and re.search(told, items.pop(("shape", deadly))[1])
    assert {end for end, _ in items.values()} == {"ok"} and len(items) == 9

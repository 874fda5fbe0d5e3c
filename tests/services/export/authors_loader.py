"""A reader of the authors' layout, written from its description in words alone: it imports nothing of this project.

A folder for each category; camPoses.txt with 20 columns; row i is paired with row i + 1 by its place in the file.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass
class Object:
    """A line of objects%05d.dat."""

    category: str
    instance: str
    region: int
    centre: tuple[int, int]
    T_cam_obj: NDArray


@dataclass
class Pose:
    """A line of camPoses.txt, and the file of objects beside it."""

    number: int
    parent: int
    pitch: float
    yaw: float
    T_world_cam: NDArray
    objects: list[Object]


@dataclass
class Pair:
    """Two poses and every image of theirs."""

    front: Pose
    back: Pose
    images: dict[str, NDArray]


FULL = ("rgb{0}", "depth{0}", "segment{0}", "rgb{1}", "depth{1}", "segment{1}", "rgbProj{0}", "depthProj{0}")
PATCHES = (
    *(f"{kind}In{{0}}{side}obj0" for kind in ("rgb", "depth", "segment") for side in ("yaw0", "yaw-179")),
    *("distIn{0}yaw0obj0", "rgbProj{0}yaw-179obj0", "depthProj{0}yaw-179obj0"),
)


def load_pairs(folder: Path) -> Iterator[Pair]:
    """Every pair of a category's folder."""
    poses = [read_pose(folder, line) for line in (folder / "camPoses.txt").read_text().splitlines()]
    assert [pose.number for pose in poses] == list(range(len(poses))), "ids have gaps"
    assert len(poses) % 2 == 0, "a pose has no partner"
    for front, back in zip(poses[::2], poses[1::2], strict=True):
        assert front.parent == back.parent == front.number, "rows that are next to each other are no pair"
        yield Pair(front, back, dict(read_images(folder, front.number, back.number)))


def read_pose(folder: Path, line: str) -> Pose:
    words = line.split(" ")
    assert len(words) == 20
    number, parent = int(words[0]), int(words[1])
    pitch, yaw, *matrix = map(float, words[2:])
    lines = (folder / f"objects{number:05d}.dat").read_text().splitlines()
    return Pose(number, parent, pitch, yaw, np.reshape(matrix, (4, 4)), [read_object(one) for one in lines])


def read_object(line: str) -> Object:
    category, instance, region, cx, cy, *matrix = line.split(" ")
    assert len(matrix) == 16
    return Object(category, instance, int(region), (int(cx), int(cy)), np.reshape(list(map(float, matrix)), (4, 4)))


def read_images(folder: Path, front: int, back: int) -> Iterator[tuple[str, NDArray]]:
    """(name with 0 for the front and 1 for the back, pixels); colour is RGB."""
    for pattern in (*FULL, *PATCHES):
        path = folder / (pattern.format(f"{front:05d}", f"{back:05d}") + ".png")
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert pixels is not None, f"{path.name} is missing"
        name = pattern.format(0, 1)
        kind = np.uint16 if name.startswith(("depth", "dist")) else np.uint8
        assert pixels.dtype == kind, f"{path.name} is {pixels.dtype}"
        yield name, pixels[..., ::-1] if name.startswith("rgb") else pixels


@dataclass
class One:
    """An object of a pair as the class for several objects reads it: its place among them, and its images."""

    number: int
    place: int
    front: Object
    back: Object
    images: dict[str, NDArray]


def load_several(folder: Path) -> Iterator[One]:
    """Every object whose line is the same in both files of a pair and whose images all exist; line 0 is the table."""
    files = sorted(folder.glob("objects*.dat"))
    for front, back in zip(files[::2], files[1::2], strict=True):
        number = int(front.stem.removeprefix("objects"))
        sides = [list(map(read_object, path.read_text().splitlines())) for path in (front, back)]
        for line, (a, b) in enumerate(zip(*sides, strict=True)):
            if not line or (a.category, a.instance, a.region) != (b.category, b.instance, b.region):
                continue
            names = {f"{kind}{side}": f"{kind}{number + bool(side):05d}" for kind in KINDS for side in ("", "_back")}
            names |= {f"{k}In{s}": f"{k}In{number:05d}{s}obj{line - 1}" for k in KINDS for s in ("yaw0", "yaw-179")}
            names |= {f"{kind}Proj": f"{kind}Proj{number:05d}yaw-179obj{line - 1}" for kind in KINDS[:2]}
            if all((folder / f"{name}.png").exists() for name in names.values()):
                yield One(
                    number,
                    line - 1,
                    a,
                    b,
                    {k: np.asarray(cv2.imread(str(folder / f"{v}.png"), -1)) for k, v in names.items()},
                )


KINDS = ("rgb", "depth", "segment")

"""Files of a range in the output folder: each by itself, or images in a tar archive for each range and category.

`mug/RGB00042.png` is the member `00042.RGB.png` of `mug/<start>.tar`, its patch `mug/patches/RGB00042.png` the member
`00042.RGB.patch.png`, and with several objects `00042.RGB.patch.obj1.png`. The labels of the pose are `00042.json`. The pose
id comes first, up to a point, so tools that group members by it (WebDataset among them) see one sample for each pose.

A label has the rows of the pose's views by role, each with its objects, and the columns of its scene and its assets that
training asks for: the tar alone is enough to train from. The tables stay what is checked and queried; the label repeats them.
"""

import contextlib
import hashlib
import io
import json
import re
import tarfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import IO, Any, cast

import pyarrow as pa

from schemas.dataset.commit import FileEntry, Span
from schemas.dataset.layout import (
    IMAGES,
    Content,
    file_pose_id,
    image_path,
    is_shape,
    patch_path,
    tar_path,
    view_name,
)
from schemas.errors import CorruptError, plain_line
from schemas.job.cameras import CAMERA_NAME
from schemas.scene.view import MODALITIES
from workers.store.store import Stage

Rows = Mapping[str, Sequence[Mapping[str, Any]]]
"""Rows by table, with the values that Arrow gives: a double that happens to be whole is still a float."""

LABEL_TABLES = ("scenes", "views", "objects", "assets")
"""The tables that labels repeat."""

SCENE_COLUMNS = (
    *("scene_id", "category", "instance_id", "source", "table_id", "object_scale", "T_world_obj", "T_world_table"),
    *("pose", "settings_digest"),
)
BODY_COLUMNS = ("region_id", "category", "instance_id", "source", "object_scale", "T_world_obj")
ASSET_COLUMNS = ("category", "source", "licence", "split", "sha256", "extents_m")
NOT_OF_A_VIEW = frozenset({"files", "scene_id", "category"})
NOT_OF_AN_OBJECT = frozenset({"pose_id", "role", "scene_id"})
"""Columns that the label says elsewhere, or, as the files of a view, that its tar says by its members."""


def pose_labels(rows: Rows) -> dict[tuple[str, int], dict[str, Any]]:
    """The label of every pose of one or more scenes, by category and the id in the names of its files.

    A view whose scene has no row is left out.
    """
    scenes = {row["scene_id"]: row for row in rows["scenes"]}
    assets = {row["instance_id"]: row for row in rows["assets"]}
    objects = defaultdict(list)
    for row in rows["objects"]:
        objects[row["pose_id"], view_name(row["role"], row["number"])].append(row)
    labels: dict[tuple[str, int], dict[str, Any]] = {}
    for view in rows["views"]:
        scene, pose_id = scenes.get(view["scene_id"]), file_pose_id(view["role"], view["parent_id"])
        if scene is None:
            continue
        key = (view["category"], pose_id)
        label = labels.setdefault(key, {"pose_id": pose_id, "views": {}, **_of_scene(scene, assets)})
        name = view_name(view["role"], view["number"])
        seen = sorted(objects[view["pose_id"], name], key=lambda row: row["region_id"])
        label["views"][name] = {
            **{name: value for name, value in view.items() if name not in NOT_OF_A_VIEW},
            "objects": [{name: value for name, value in row.items() if name not in NOT_OF_AN_OBJECT} for row in seen],
        }
    return labels


def _of_scene(scene: Mapping[str, Any], assets: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """What all poses of a scene share; `split` is that of the first object."""
    bodies = scene["bodies"] or []
    used = {scene["table_id"], scene["instance_id"], *(body["instance_id"] for body in bodies)}
    return {
        "scene": {
            **{name: scene[name] for name in SCENE_COLUMNS},
            "bodies": [{name: body[name] for name in BODY_COLUMNS} for body in bodies],
        },
        "assets": {name: {column: assets[name][column] for column in ASSET_COLUMNS} for name in used if name in assets},
        "split": assets[scene["instance_id"]]["split"] if scene["instance_id"] in assets else None,
    }


def encode_label(label: Mapping[str, Any]) -> bytes:
    """Canonical JSON: sorted keys, and of every double the shortest digits that give it back."""
    text = json.dumps(label, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"


def decode_label(data: bytes) -> dict[str, Any]:
    """A stored label. Raises ValueError."""
    try:
        label = json.loads(data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(label, dict):
        raise ValueError("it holds no keys")
    return label


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """(dotted path, text) of every value that is not a list or a mapping with items."""
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    if not items or not value:
        yield path, repr(value)
    for key, inner in items:
        yield from _leaves(inner, f"{path}.{key}".lstrip("."))


_CONTENT = rf"(?P<content>[A-Za-z]+(?:\d+_[A-Za-z]*)?|[A-Za-z]+\d*_(?P<name>{CAMERA_NAME})_)"
_PATH = re.compile(
    rf"(?P<category>[^/]+)/(?P<patch>patches/)?{_CONTENT}(?P<pose>\d{{5,}})(?:_(?P<number>\d{{3}}))?(?:obj(?P<object>\d+))?\.png"
)
_MEMBER = re.compile(
    rf"(?P<pose>\d{{5}}|[1-9]\d{{5,}})\.{_CONTENT}(?P<number>\d{{3}})?(?P<patch>\.patch)?(?:\.obj(?P<object>0|[1-9]\d*))?\.png"
)
_LABEL = re.compile(r"(?P<pose>\d{5}|[1-9]\d{5,})\.json", re.ASCII)
_WORDS = frozenset(modality.word.rstrip("_") for modality in MODALITIES.values())
_CONTENTS: list[str] = list(dict.fromkeys(image.content for image in IMAGES))


def member_of(path: str) -> tuple[str, str]:
    """(category, member name) of an image. Raises ValueError where the path is not an image's."""
    parts = _match(_PATH, path)
    index = "" if parts["object"] is None else f".obj{parts['object']}"
    content = parts["content"] + (parts["number"] or "")
    return parts["category"], f"{parts['pose']}.{content}{'.patch' if parts['patch'] else ''}{index}.png"


def path_of(category: str, member: str) -> str:
    """The path of the image that a member holds. Raises ValueError where the name is not a member's."""
    parts = _match(_MEMBER, member)
    index = None if parts["object"] is None else int(parts["object"])
    name, pose_id = cast(Content, parts["content"]), int(parts["pose"])
    if parts["patch"]:
        return patch_path(category, name, pose_id, index)
    return image_path(category, name, pose_id, index, None if parts["number"] is None else int(parts["number"]))


def member_order(path: str) -> tuple[int, int, str, int, bool, int]:
    """Sorts the images of a scene: by pose, then in the order of the article's figure 1, each before its patches.

    Those of named cameras come last, by the word in their names and their number.
    """
    parts = _match(_PATH, path)
    content, named = parts["content"], parts["name"] is not None
    place = (len(_CONTENTS), content) if named else (_CONTENTS.index(content), "")
    return int(parts["pose"]), *place, int(parts["number"] or 0), bool(parts["patch"]), int(parts["object"] or 0)


def label_member(pose_id: int) -> str:
    """The name of the member that holds a pose's labels."""
    return f"{pose_id:05d}.json"


def read_tar(category: str, data: bytes, name: str) -> Iterator[tuple[str, bytes]]:
    """(image path, bytes) of every image, in order. Raises CorruptError naming the archive where it is damaged."""
    return ((path, content) for path, _, content in _read_members(category, data, name) if path)


def check_labels(category: str, data: bytes, name: str, rows: Rows) -> list[tuple[int, str]]:
    """(pose id, how its labels differ from the rows of the range) of every pose in an archive whose labels are off.

    `rows` are those of all the range's scenes. Raises CorruptError as `read_tar`.
    """
    stored, imaged = {}, set()
    for path, pose_id, content in _read_members(category, data, name):
        if path:
            imaged.add(pose_id)
        else:
            stored[pose_id] = content
    derived = pose_labels(rows)
    faults = [(pose_id, f"{name}: {label_member(pose_id)} is missing") for pose_id in sorted(imaged - stored.keys())]
    for pose_id, content in stored.items():
        if fault := _label_fault(content, derived.get((category, pose_id))):
            faults.append((pose_id, f"{name}: {label_member(pose_id)} {fault}"))
    return faults


def _label_fault(content: bytes, derived: Mapping[str, Any] | None) -> str:
    """How a stored label differs from the tables'; empty where it does not. A key that was added since is none."""
    if derived is None:
        return "is of a pose that the tables do not have"
    try:
        mine, theirs = dict(_leaves(decode_label(content))), dict(_leaves(derived))
    except ValueError as error:
        return f"is no label: {plain_line(str(error))}"
    different = [path for path in sorted(mine.keys() | theirs) if mine.get(path, "None") != theirs.get(path)]
    return f"differs from the tables at {', '.join(map(plain_line, different[:3]))}" if different else ""


def _read_members(category: str, data: bytes, name: str) -> Iterator[tuple[str, int, bytes]]:
    """(image path, empty for labels; pose id; bytes) of every member, in order."""
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for header in archive:
                label = _LABEL.fullmatch(header.name)
                path = "" if label else path_of(category, header.name)
                pose_id = int(label["pose"]) if label else member_order(path)[0]
                file = archive.extractfile(header) if header.isreg() else None
                if file is None:
                    raise ValueError(f"{header.name} is no file")
                yield path, pose_id, file.read()
    except (tarfile.TarError, ValueError, EOFError) as error:
        raise CorruptError(f"{name} is not a whole archive of images: {error}") from error


class Packing:
    """Stores an attempt's files scene by scene: by path, or, with `tar`, images in archives and shapes by path."""

    def __init__(self, stage: Stage, span: Span, tar: bool) -> None:
        self._stage = stage
        self._span = span
        self._tar = tar
        self._archives: dict[str, _Archive] = {}

    def add(self, files: Mapping[str, bytes], tables: Mapping[str, pa.Table]) -> None:
        """Stores the files of one scene by path; images go into archives in their fixed order, and labels after them.

        `tables` are the scene's rows. Raises FileNotFoundError where the attempt's folder was swept, ValueError where a
        name has no place here.
        """
        images = [path for path in files if self._tar and not is_shape(path)]
        for path, data in files.items():
            if not self._tar or is_shape(path):
                self._stage.write(path, data)
        labels = pose_labels({table: tables[table].to_pylist() for table in LABEL_TABLES}) if images else {}
        for (category, pose_id), paths in groupby(
            sorted(images, key=member_order), key=lambda path: (member_of(path)[0], member_order(path)[0])
        ):
            if category not in self._archives:
                name = tar_path(category, self._span.start, self._span.retry)
                self._archives[category] = _Archive(name, self._stage.stream(name))
            for path in paths:
                self._archives[category].add(member_of(path)[1], files[path])
            self._archives[category].add(label_member(pose_id), encode_label(labels[category, pose_id]))

    def finish(self) -> list[FileEntry]:
        """The archives, finished. Nothing can be added afterwards."""
        return [archive.finish() for archive in self._archives.values()]

    def close(self) -> None:
        """Closes all archives, unfinished."""
        for archive in self._archives.values():
            archive.close()


class _Archive:
    """A tar being written; its bytes are counted and hashed on the way."""

    def __init__(self, path: str, stream: contextlib.AbstractContextManager[IO[bytes]]) -> None:
        self._path = path
        self._open = contextlib.ExitStack()
        self._file = self._open.enter_context(stream)
        self._bytes = 0
        self._sha256 = hashlib.sha256()

    def add(self, member: str, data: bytes) -> None:
        header = tarfile.TarInfo(member)  # mode 0644, no owner, time 0: it depends on name and size alone
        header.size = len(data)
        self._write(header.tobuf(tarfile.USTAR_FORMAT) + data + bytes(-len(data) % tarfile.BLOCKSIZE))

    def finish(self) -> FileEntry:
        end = 2 * tarfile.BLOCKSIZE
        self._write(bytes(end + -(self._bytes + end) % tarfile.RECORDSIZE))
        self._open.close()
        return FileEntry(path=self._path, bytes=self._bytes, sha256=self._sha256.hexdigest())

    def close(self) -> None:
        with contextlib.suppress(GeneratorExit), self._open:
            raise GeneratorExit  # ends the stream, which is not stored then

    def _write(self, data: bytes) -> None:
        try:
            self._file.write(data)
        except OSError:
            with self._open:
                raise  # by way of the stream, which says what to do
        self._bytes += len(data)
        self._sha256.update(data)


def _match(pattern: re.Pattern[str], name: str) -> re.Match[str]:
    match = pattern.fullmatch(name)
    named = match is not None and match["name"] is not None
    if match is None or (
        match["content"].partition("_")[0] not in _WORDS if named else match["content"] not in _CONTENTS
    ):
        raise ValueError(f"{name!r} is not the name of an image")
    return match

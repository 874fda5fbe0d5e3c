"""The labels of one pose as JSON, which lies beside its images in a tar: the tar alone is enough to train from. Pure.

A pose's label has the rows of its views by role, each with its objects, and the columns of its scene and its assets that
training asks for. The tables stay what is checked and queried; the label repeats them.
"""

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from schemas.dataset.layout import file_pose_id

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
        objects[row["pose_id"], row["role"]].append(row)
    labels: dict[tuple[str, int], dict[str, Any]] = {}
    for view in rows["views"]:
        scene, pose_id = scenes.get(view["scene_id"]), file_pose_id(view["role"], view["parent_id"])
        if scene is None:
            continue
        key = (view["category"], pose_id)
        label = labels.setdefault(key, {"pose_id": pose_id, "views": {}, **_of_scene(scene, assets)})
        own = sorted(objects[view["pose_id"], view["role"]], key=lambda row: row["region_id"])
        label["views"][view["role"]] = {
            **{name: value for name, value in view.items() if name not in NOT_OF_A_VIEW},
            "objects": [{name: value for name, value in row.items() if name not in NOT_OF_AN_OBJECT} for row in own],
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


def label_differences(stored: Any, derived: Any, path: str = "") -> Iterator[str]:
    """Dotted paths at which a stored label differs from the tables'; of keys that were added since, none counts as equal."""
    if isinstance(stored, dict) and isinstance(derived, dict):
        for name in sorted(stored.keys() | derived.keys()):
            if name not in stored and derived[name] is None:
                continue
            inner = f"{path}.{name}" if path else name
            if name not in stored or name not in derived:
                yield inner
            else:
                yield from label_differences(stored[name], derived[name], inner)
    elif isinstance(stored, list) and isinstance(derived, list) and len(stored) == len(derived):
        for number, (one, other) in enumerate(zip(stored, derived, strict=True)):
            yield from label_differences(one, other, f"{path}.{number}")
    elif type(stored) is not type(derived) or repr(stored) != repr(derived):
        yield path

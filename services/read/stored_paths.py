"""The paths of a view's images that are stored, by its row of `views`. Pure."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from schemas.dataset.layout import IMAGES, PixelKind, image_path, patch_path


def view_paths(row: Mapping[str, Any]) -> Mapping[PixelKind, str]:
    """The paths of a view's images that are stored, by kind."""
    named = {i.pixels: image_path(row["category"], i.content, row["pose_id"]) for i in IMAGES if i.role == row["role"]}
    return _stored(row, named)


def patch_paths(row: Mapping[str, Any], index: int | None) -> Mapping[PixelKind, str]:
    """The paths of the patches of a view's object that are stored, by kind."""
    named = {
        i.pixels: patch_path(row["category"], i.content, row["pose_id"], index) for i in IMAGES if i.role == row["role"]
    }
    return _stored(row, named)


def _stored(row: Mapping[str, Any], named: Mapping[PixelKind, str]) -> Mapping[PixelKind, str]:
    listed = {file["path"] for file in row["files"]}
    return MappingProxyType({kind: path for kind, path in named.items() if path in listed})

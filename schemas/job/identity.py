"""The identity of a job: the digest of its keys that differ from their defaults, for a dataset and for a scene.

A key that a later version adds has its default in every older job, and leaves their digests as they are. A default that changes
makes another dataset of an older job: it is a new version of that key. The path of a folder of assets or of captures is never
part of a digest: the catalogue's digest covers the files.
"""

import hashlib
import json
from collections.abc import Collection
from typing import Any

from pydantic import BaseModel

from schemas.job.job import Job

PATHS = frozenset({"assets.objects.folder", "assets.tables.folder", "captures.folders"})
"""Keys that name places, where the same files may lie elsewhere."""

NOT_OF_A_DATASET = PATHS | {"scenes", "run", "preset"}
"""Keys that may change from one run on a folder to the next: more scenes, how the work is driven, and what filled other keys."""

NOT_OF_A_SCENE = NOT_OF_A_DATASET | {"name", "first_scene", "output"}
"""Keys that do not change what a scene is."""


def job_digest(job: Job, catalogue_digest: str) -> str:
    """SHA-256, hex, of all that must stay the same on one output folder."""
    return _digest(job, NOT_OF_A_DATASET, catalogue_digest)


def settings_digest(job: Job, catalogue_digest: str) -> str:
    """SHA-256, hex, of all that decides what a scene is."""
    return _digest(job, NOT_OF_A_SCENE, catalogue_digest)


def compare_jobs(before: Job, now: Job) -> list[tuple[str, Any, Any]]:
    """(dotted key, value before, value now) of every key that must stay the same and does not."""
    there, here = (_keys_of(job, NOT_OF_A_DATASET, all_keys=True) for job in (before, now))
    return _differences(there, here)


def differing_keys(model: BaseModel, without: Collection[str] = ()) -> dict[str, Any]:
    """The keys of a model, as JSON holds them, whose values differ from their fields' defaults.

    Inside a branch or an item of a list too; keys without a default, such as the kind of a source, are always there. `without`:
    dotted keys that are left out; items of a list have no position in them.
    """
    return _keys_of(model, without)


def _digest(job: Job, without: Collection[str], catalogue_digest: str) -> str:
    keys = {"verso": job.verso, **differing_keys(job, without)}
    text = json.dumps([keys, catalogue_digest], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _keys_of(model: BaseModel, without: Collection[str], all_keys: bool = False) -> dict[str, Any]:
    def walk(value: Any, plain: Any, path: str) -> Any:
        """What stays of `plain`, which is `value` as JSON holds it."""
        if isinstance(plain, list):
            return [walk(*both, path) for both in zip(value, plain, strict=True)]
        if not isinstance(value, BaseModel):
            return plain
        kept = {}
        for name, field in type(value).model_fields.items():
            key, inside = f"{path}{name}", getattr(value, name)
            usual = not field.is_required() and inside == field.get_default(call_default_factory=True)
            if key not in without and (all_keys or not usual):
                kept[name] = walk(inside, plain[name], f"{key}.")
        return kept

    return dict(walk(model, model.model_dump(mode="json"), ""))


def _differences(a: Any, b: Any, path: str = "") -> list[tuple[str, Any, Any]]:
    if isinstance(a, dict) and isinstance(b, dict):
        keys = [*a, *(key for key in b if key not in a)]
        return [
            line
            for key in keys
            for line in _differences(a.get(key, "absent"), b.get(key, "absent"), f"{path}.{key}" if path else key)
        ]
    return [] if a == b else [(path, a, b)]

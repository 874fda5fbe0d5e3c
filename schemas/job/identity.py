"""The identity of a job: which of its keys decide the dataset, which decide a scene, and their digests.

The path of a folder of assets or of a capture is never part of it: the catalogue's digest covers the files.
"""

import hashlib
import json
from typing import Any

from schemas.job.assets import FILES, FORMER
from schemas.job.job import Job

RUN_KEYS = frozenset({"scenes", "run"})
"""Keys that may change from one run on a folder to the next: more scenes, and how the work is driven."""

NOT_IN_A_SCENE = RUN_KEYS | {"name", "first_scene", "output", "verso", "preset"}
"""Keys that do not change what a scene is."""


def job_digest(job: Job, catalogue_digest: str) -> str:
    """SHA-256, hex, of all that must stay the same on one output folder."""
    return _digest(dataset_keys(job), catalogue_digest)


def settings_digest(job: Job, catalogue_digest: str) -> str:
    """SHA-256, hex, of all that decides what a scene is. A sensor effect that is off decides nothing and is left out."""
    keys = dataset_keys(job)
    settings = {name: value for name, value in keys.items() if name not in NOT_IN_A_SCENE}
    settings["sensor"] = {name: effect for name, effect in settings["sensor"].items() if effect is not None}
    if not settings["sensor"]:
        del settings["sensor"]
    return _digest(settings, catalogue_digest)


def compare_jobs(before: Job, now: Job) -> list[tuple[str, Any, Any]]:
    """(dotted key, value before, value now) of every key that must stay the same and does not."""
    return _differences(dataset_keys(before), dataset_keys(now))


def dataset_keys(job: Job) -> dict[str, Any]:
    """The job's keys and values, as JSON holds them, that must stay the same on one output folder."""
    keys = job.model_dump(mode="json", exclude=set(RUN_KEYS))
    for source in (*keys["assets"]["objects"], *keys["assets"]["tables"]):
        source.pop("folder", None)
        source["source"] = FORMER if source["source"] == FILES else source["source"]  # as the first datasets have it
    if job.captures is not None:
        for unused in ("folders", "simulate", "board") if job.captures.folders else ("folders", "category"):
            del keys["captures"][unused]
    return keys


def _digest(keys: dict[str, Any], catalogue_digest: str) -> str:
    text = json.dumps([keys, catalogue_digest], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _differences(a: Any, b: Any, path: str = "") -> list[tuple[str, Any, Any]]:
    if isinstance(a, dict) and isinstance(b, dict):
        keys = [*a, *(key for key in b if key not in a)]
        return [
            line
            for key in keys
            for line in _differences(a.get(key, "absent"), b.get(key, "absent"), f"{path}.{key}" if path else key)
        ]
    return [] if a == b else [(path, a, b)]

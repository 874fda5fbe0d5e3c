"""The `check`, `output` and `run` branches of a job: what is checked, how files are laid out, how the work is driven."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Frozen, Positive, PositiveInt, Share

RangeSize = Annotated[int, Field(ge=1, le=100_000)]
"""A worker keeps the rows of a whole range, some kilobytes a scene."""


class Check(Frozen):
    """What is checked before a scene is committed."""

    raycast_share: Share = 0.01
    """Share of scenes, chosen by scene id, whose depth and masks are compared with a ray caster, and whose objects are
    released again to see that they stay where they are."""
    mirror_agreement_mm: Positive = 1.0
    """Largest median difference between input depth carried into the mirror view and the mirror depth."""


class Output(Frozen):
    """How files are laid out."""

    layout: Literal["files", "tar"] = "files"
    """`tar`: one tar for each range and category, with images and labels; required on object stores."""


class Run(Frozen):
    """Workers, shards, ranges and limits. None of these keys changes a byte of the dataset."""

    workers: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """None: the cores that this container may use, or the cluster's."""
    shard_size: PositiveInt | None = None
    """Scenes in a Ray task; rounded up to whole ranges. None: at most 64, and fewer towards the end."""
    range_size: RangeSize | None = None
    """Scenes in a commit; recorded at the first run. None: at most 16, and fewer where scenes are few or slow."""
    max_failure_share: Share = 0.01
    """Above this share of failed scenes the run exits 1, and stops early once that is certain."""
    max_attempts: PositiveInt = 3
    """Tries of a range whose worker dies, before the scene it died in is recorded as an environmental failure."""
    scene_timeout_s: Positive = 120.0
    """A worker that takes longer over one scene is killed."""
    device: Literal["any", "gpu"] = "any"
    """Allowed renderers: `gpu` refuses workers where OpenGL runs in software, on the CPU."""
    fingerprint: Literal["strict", "record"] = "strict"
    """`strict` refuses workers whose stack makes other bytes; `record` allows them and stores which made what."""

"""The job file: one tree of frozen models, parsed once; and its identity, for a dataset and for a scene.

Every key but `name` has a default, and an unknown key is an error. A digest is that of the keys that differ from their defaults:
a key that a later version adds leaves the digests of older jobs as they are, and a default that changes makes another dataset
of an older job, so it is a new version of that key. The path of a folder of assets or of captures is never part of a digest: the
catalogue's digest covers the files. So it is with tables of poses and of scenes.
"""

import hashlib
import json
import math
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field, model_validator

from schemas.base import Folder, Frozen, NonNegativeInt, Positive, PositiveInt, Seed, Share, with_defaults
from schemas.job.assets import (
    CATEGORIES,
    TABLE,
    Assets,
    CategoryWeights,
    describe_unknown,
    offered_by,
    sources_of,
    with_categories,
)
from schemas.job.cameras import Cameras
from schemas.job.captures import Captures, with_capture_keys
from schemas.job.look import OF_COLOUR, Look
from schemas.job.physics import ONE_OBJECT, ObjectCount, Physics, Start
from schemas.job.views import Images, Render, SensorEffects, Studio, Targets

RangeSize = Annotated[int, Field(ge=1, le=100_000)]
"""A worker keeps the rows of a whole range, some kilobytes a scene."""


class Check(Frozen):
    """What is checked before a scene is committed."""

    raycast_share: Share = 0.01
    """Share of scenes whose depth and masks are compared with a ray caster, and whose objects are let go again."""
    mirror_agreement_mm: Positive = 1.0
    """Largest median difference of input depth carried into the mirror view from mirror depth."""
    overlap_mm: Positive = 1.0
    """Deepest that bodies may lie in one another where `scenes_from` puts them: beyond it the scene fails."""


class Output(Frozen):
    """How files are laid out."""

    layout: Literal["files", "tar"] = "files"
    """`tar`: one tar for each range and category, with images and labels; required on object stores."""


class Run(Frozen):
    """Workers, shards, ranges and limits. None of these keys changes a byte of the dataset."""

    workers: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """None: this container's cores, or the cluster's."""
    shard_size: PositiveInt | None = None
    """Scenes in a Ray task, in whole ranges. None: at most 64, fewer towards the end."""
    range_size: RangeSize | None = None
    """Scenes in a commit; recorded at the first run. None: at most 16, fewer where scenes are few or slow."""
    max_failure_share: Share = 0.01
    """Above this share of failed scenes the run exits 1."""
    max_attempts: PositiveInt = 3
    """Tries of a range whose worker dies, before its scene fails as environmental."""
    scene_timeout_s: Positive = 120.0
    """A worker that takes longer over one scene is killed. 600 in tier pathtraced, 1800 for captures."""
    device: Literal["any", "gpu"] = "any"
    """`gpu` refuses workers that draw in software."""
    workers_per_gpu: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Workers that share a GPU. None: as few as leave no core idle."""
    fingerprint: Literal["strict", "record"] = "strict"
    """`strict` refuses workers whose stack makes other bytes; `record` stores which stack made what."""


MOST = 16
"""Of quick scenes: a few seconds of work, of which a commit takes about a hundredth."""

FEWEST_RANGES = 32
"""A job has as many ranges at least, if it has the scenes: for that many workers, or for a few that end together."""

RANGE_S = 10.0
"""Processor time that a range should take: about what is lost with a worker."""

SCENE_S, FALLING_S, PILED_S = 0.12, 0.1, 0.25
"""Processor time of a pair with one object (measured), of each further object spread out (a guess), and of each in a pile (a
pile of eight takes 1.7 s on average)."""

PATH_S = 1.0
"""Processor time of each path through every pixel of a pair's three images: 16 paths take 5.6 s an image."""


VIEW_S = 0.03
"""Processor time of a further view (measured at 512 x 512 with normals)."""


PresetName = Literal["fast", "balanced", "exact"]
JobKind = Literal["singles", "piles", "meshes", "captures"]
Keys = Mapping[str, Any]
"""Values by dotted key of a job."""

_SCENES: Mapping[PresetName, Keys] = {
    "fast": {"physics.step_hz": 240, "render.tier": "flat", "render.samples": 1},
    "balanced": {"physics.step_hz": 960, "render.tier": "raster", "render.samples": 1},
    "exact": {"physics.step_hz": 1920, "render.tier": "raster", "render.samples": 4},
}

PRESETS: Mapping[JobKind, Mapping[PresetName, Keys]] = {
    "singles": _SCENES,
    # Longer steps end in piles that find no balance and fall again: they save nothing, and may take several times as long.
    "piles": {**_SCENES, "fast": {"physics.step_hz": 960, "render.tier": "flat", "render.samples": 1}},
    "meshes": _SCENES,
    "captures": {
        "fast": {"captures.fusion.voxel_m": 0.002, "captures.synthesis.views": 1},
        "balanced": {"captures.fusion.voxel_m": 0.002, "captures.synthesis.views": 6},
        "exact": {"captures.fusion.voxel_m": 0.0015, "captures.synthesis.views": 6},
    },
}
"""Values by kind of job, preset and dotted key, from the studies in docs/tradeoff; all presets of a kind set the same keys.
They set effort, and never what an image holds (size, units, how d_z is read). `balanced` equals the keys' own defaults."""


def kind_of(tree: Keys) -> JobKind:
    """Which of the four kinds a job is, by its keys, of which any may be missing or wrong."""
    if isinstance(tree.get("captures"), Mapping):
        return "captures"
    count = tree.get("objects_per_scene", 1)
    if (count[-1:] if isinstance(count, list | tuple) else [count]) not in ([1], (1,)):
        return "piles"
    return "singles" if all(source.get("source") == "procedural" for source in sources_of(tree)) else "meshes"


def with_preset(tree: Keys) -> dict[str, Any]:
    """A copy of a job's keys, with those of its preset and kind where the job does not give them.

    An unknown preset is left to validation; a branch that is no mapping is left as it is.
    """
    preset = tree.get("preset", "balanced")
    return with_defaults(tree, next((keys for name, keys in PRESETS[kind_of(tree)].items() if name == preset), {}))


STUDIO: Keys = {
    "start.pose": "as_given",
    "cameras.orbit.radius_m": "25%",
    "cameras.mirror.enabled": False,
    "cameras.mirror.T_z_m": "fit",
    "cameras.depth.enabled": False,
    "images.projection.enabled": False,
}
"""Defaults of a job of studio scenes."""

PATHTRACED: Keys = {"run.scene_timeout_s": 600.0}
"""Default of tier pathtraced: beside other work a process may take minutes to compile what its first scene needs."""


def with_kind_keys(tree: Keys) -> dict[str, Any]:
    """A copy of a job's keys, with the defaults of studio scenes and of tier pathtraced where the job does not give them."""
    render = tree.get("render")
    traced = isinstance(render, Mapping) and render.get("tier") == "pathtraced"
    return with_defaults(tree, {**(STUDIO if tree.get("scene") == "studio" else {}), **(PATHTRACED if traced else {})})


MOST_SCENE_IDS = 10**10
"""Ids of scenes have ten digits in the names of ranges, which sort like numbers."""


_NAMES = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def _usable(name: str) -> str:
    if not _NAMES.fullmatch(name):
        raise ValueError(
            "a name is 1 to 64 letters, digits, ., - and _, the first a letter or digit: it names a folder"
        )
    return name


class Job(Frozen):
    """A whole job file."""

    verso: Literal[1] = 1
    """schema_version."""
    name: Annotated[str, Field(max_length=1000), AfterValidator(_usable)]
    """Names the dataset; the default output folder is data/<name>."""
    preset: PresetName = "balanced"
    """Defaults of other keys, by kind of job; docs/measured.md has what they cost."""
    seed: Seed = 0
    """Seed of all that is random in a scene."""
    scenes: PositiveInt = 64
    """Scenes or captures; more than before extend a dataset. Default with captures.folders: their number."""
    first_scene: NonNegativeInt = 0
    """Id of the first scene."""
    pairs_per_scene: Annotated[int, Field(ge=1, le=1000)] = 1
    """Pairs of each scene, or views of a capture that are stored at most (default 64)."""
    scenes_from: Folder | None = None
    """Scenes in place of drawn ones: a table (.csv, .parquet or .json) of objects and cameras, the folder of a finished dataset,
    or of a scene in the BOP layout (docs/scenes.md)."""
    objects_per_scene: ObjectCount = ONE_OBJECT
    """Objects on the table; a range is drawn from evenly. The first gives the scene's category."""
    categories: CategoryWeights = Field(default_factory=lambda: dict.fromkeys(CATEGORIES, 1.0), min_length=1)
    """Weights of the categories that the sources offer; a list gives equal weights."""
    assets: Assets = Assets()
    """Where shapes come from."""
    start: Start = Start()
    """How an object begins."""
    physics: Physics = Physics()
    """How objects come to rest."""
    scene: Literal["tabletop", "studio"] = "tabletop"
    """tabletop: objects at rest on a table; studio: one object alone, on nothing, with the look of `studio`."""
    studio: Studio = Studio()
    """Scale, light and background of `scene: studio`."""
    cameras: Cameras = Cameras()
    """Every camera of a scene."""
    images: Images = Images()
    """Encodings, patches and projection."""
    render: Render = Render()
    """How RGB is made."""
    look: Look = Look()
    """Light and surroundings."""
    sensor: SensorEffects = SensorEffects()
    """Effects of real sensors on exact images; none by default."""
    targets: Targets = Targets()
    """What networks are trained on beside the article's images; none by default."""
    check: Check = Check()
    """What is checked before a scene is committed."""
    captures: Captures | None = None
    """Captures of objects on a marker board in place of scenes."""
    output: Output = Output()
    """How files are laid out."""
    run: Run = Run()
    """How the work is driven: changes no byte."""

    @model_validator(mode="before")
    @classmethod
    def _fill(cls, value: object) -> object:
        if not isinstance(value, dict):
            return value
        return with_categories(with_preset(with_kind_keys(with_capture_keys(value))))

    @model_validator(mode="after")
    def _has_ids(self) -> "Job":
        if self.stop_scene > MOST_SCENE_IDS:
            limit = f"and names of files have room for ids below {MOST_SCENE_IDS}"
            raise ValueError(f"first_scene + scenes is {self.stop_scene}, {limit}")
        return self

    @model_validator(mode="after")
    def _offers_categories(self) -> "Job":
        # Names of libraries are known where they are opened.
        built_in = all(source.source == "procedural" for source in self.assets.objects)
        if built_in and (unknown := self.describe_unknown()):
            raise ValueError(unknown)
        return self

    @model_validator(mode="after")
    def _agrees(self) -> "Job":
        if self.captures is not None and (unfit := _unfit_for_captures(self, self.captures)):
            raise ValueError(unfit)
        if unfit := _unfit_for_scene(self):
            raise ValueError(unfit)
        if self.images.projection.enabled and not self.cameras.mirror.enabled:
            remedy = "what is projected is what the mirror camera would see; set images.projection.enabled: false too"
            raise ValueError(f"images.projection.enabled is true and cameras.mirror.enabled is false: {remedy}")
        others = self.cameras.mirror.enabled or self.cameras.depth.enabled or self.cameras.more
        if "covisible" in self.targets.views and not others:
            remedy = "it says of other views what the input camera sees; name some in cameras.more, or leave it out"
            raise ValueError(f"targets.views asks for covisible, and there is no view beside the input's: {remedy}")
        if self.sensor.changes_rgb and not self.render.rgb:
            remedy = "leave out sensor.distortion, sensor.rgb_noise and sensor.exposure"
            raise ValueError(f"render.rgb is false and sensor asks for an effect on RGB: {remedy}")
        return self

    def describe_unknown(self, of_libraries: Iterable[str] = ()) -> str:
        """The first name in a map by category that neither built-in shapes nor the libraries offer, with its key; or empty."""
        offered = *offered_by([source.model_dump() for source in self.assets.objects]), *of_libraries
        maps = {
            "categories": (self.categories, ()),
            "assets.density_kg_m3": (self.assets.density_kg_m3, ()),
            "physics.friction": (self.physics.friction, (TABLE,)),
        }
        for key, (given, more) in maps.items():
            names = given if isinstance(given, Mapping) else ()
            if unknown := describe_unknown(names, (*offered, *more), key):
                return unknown
        return ""

    @property
    def has_alpha(self) -> bool:
        """Whether RGB is stored with alpha."""
        return self.scene == "studio" and self.studio.background == "transparent"

    @property
    def drawn_look(self) -> Look:
        """`look` without the branches that change colour alone, where no colour is drawn or the tier is flat."""
        if self.render.rgb and self.drawn.tier != "flat":
            return self.look
        return self.look.without(*OF_COLOUR)

    @property
    def drawn(self) -> Render:
        """How images are drawn: `render`, with the tier of virtual captures where the job makes those."""
        if self.captures is None or self.captures.folders:
            return self.render
        return self.render.model_copy(update={"tier": self.captures.simulate.tier})

    @property
    def range_size(self) -> int:
        """Scenes in a range: `run.range_size`, or what a rough estimate of a scene's time gives. It changes no byte."""
        if self.run.range_size is not None:
            return self.run.range_size
        further = PILED_S if self.start.arrange == "pile" else FALLING_S
        traced = PATH_S * self.render.path_samples if self.render.tier == "pathtraced" else 0.0
        pairs, most_objects = self.pairs_per_scene, self.objects_per_scene.high
        views = sum((entry.count or 1) * (pairs if entry.beside else 1) for entry in self.cameras.more)
        scene_s = SCENE_S * pairs + further * (most_objects - 1) + traced * pairs + (VIEW_S + traced / 3) * views
        return max(1, min(MOST, int(RANGE_S / scene_s), math.ceil(self.scenes / FEWEST_RANGES)))

    @property
    def stop_scene(self) -> int:
        """One past the last scene id."""
        return self.first_scene + self.scenes


def _unfit_for_scene(job: Job) -> str | None:
    """The key that the job's kind of scene cannot have, with the remedy; None where all fit."""
    if job.scene == "tabletop":
        if job.start.pose == "as_given":
            return "start.pose is as_given, and on a table an object may not rest so: use upright, tumbled or placed"
        if job.studio != Studio():
            return "studio has keys, and scene is tabletop: set scene: studio, or leave them out"
        return None
    if job.objects_per_scene != ONE_OBJECT:
        return "scene is studio, and objects_per_scene is not 1: a studio scene shows one object"
    if job.start.pose == "placed":
        return "scene is studio, and start.pose is placed: use as_given, upright or tumbled, nothing is set down"
    if job.start.arrange == "pile":
        return "scene is studio, and start.arrange is pile: leave it out"
    if alone := [
        f"look.{name}" for name in ("floor", "table", "room", "clutter") if getattr(job.look, name) is not None
    ]:
        return f"scene is studio, and {' and '.join(alone)} is given: leave it out, an object stands on nothing there"
    if job.has_alpha and job.look.background is not None:
        return "studio.background is transparent, and look.background is given: set the former to a colour, such as [1, 1, 1]"
    if job.studio.background == "transparent" and job.sensor.changes_rgb:
        return "sensor asks for an effect on RGB, which alpha cannot follow: set studio.background to a colour, such as [1, 1, 1]"
    if lost := [entry.name for entry in job.cameras.more if entry.about == "table"]:
        return f"scene is studio, and camera {lost[0]} looks at the table, of which there is none: set about to object or world"
    if job.render.tier == "pathtraced":
        return "scene is studio, and render.tier is pathtraced: use raster or flat"
    return None


def _unfit_for_captures(job: Job, captures: Captures) -> str | None:
    """The key of a job of captures that a capture cannot have, with the remedy; None where all fit."""
    folders = len(captures.folders)
    if folders and (job.first_scene or job.scenes > folders):
        return (
            f"captures.folders names {folders} folders, and captures {job.first_scene} to {job.stop_scene - 1} are asked for: "
            f"first_scene must be 0 and scenes at most {folders}"
        )
    if not folders and captures.simulate.views > job.pairs_per_scene:
        return f"captures.simulate.views is {captures.simulate.views}, and pairs_per_scene is {job.pairs_per_scene}: raise that"
    if job.scene != "tabletop":
        return f"scene is {job.scene}: leave it out, a capture's object lies on its board"
    if job.scenes_from is not None:
        return "scenes_from has scenes, and captures are asked for: leave one of them out"
    if job.cameras.more:
        return "cameras.more names cameras: leave it out, a capture has the views that were taken"
    if job.cameras.depth.enabled:
        return "cameras.depth.enabled is true: leave it out, depth of a capture is registered to its colour camera"
    if job.objects_per_scene != ONE_OBJECT:
        return "objects_per_scene must be 1: a capture is of one object"
    shown = {"recolour"} if folders else {"recolour", "floor", "room"}
    if given := [name for name, value in job.look if name not in shown and value is not None]:
        what = (
            "photographs show what they show" if folders else "of look a virtual capture has recolour, floor and room"
        )
        return f"look.{given[0]} is given: leave it out, {what}"
    if job.sensor != SensorEffects():
        return "sensor has effects: leave them out, those of a virtual capture are keys of captures.simulate"
    if unfit := [name for name in job.targets.views if name in ("albedo", "covisible", "amodal")] + list(
        job.targets.shape
    ):
        why = "a capture has no shape but what its photographs saw; left are normals, coordinates and layers"
        return f"targets asks for {', '.join(unfit)}: {why}"
    return None if job.render.rgb else "render.rgb is false: a capture has colour, leave it out"


PATHS = frozenset(
    {
        *("assets.objects.folder", "assets.tables.folder", "captures.folders", "cameras.more.poses"),
        *("look.floor.folder", "look.table.folder", "look.background", "look.environment.folder", "scenes_from"),
    }
)
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
    there, here = (differing_keys(job, NOT_OF_A_DATASET, all_keys=True) for job in (before, now))
    return _differences(there, here)


def differing_keys(model: BaseModel, without: Collection[str] = (), all_keys: bool = False) -> dict[str, Any]:
    """The keys of a model, as JSON holds them, whose values differ from their fields' defaults.

    Inside a branch or an item of a list too; keys without a default, such as the kind of a source, are always there. `without`:
    dotted keys that are left out; items of a list have no position in them. `all_keys`: also those that do not differ.
    """

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


def _digest(job: Job, without: Collection[str], catalogue_digest: str) -> str:
    keys = {"verso": job.verso, **differing_keys(job, without)}
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

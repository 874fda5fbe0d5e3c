"""Reads a job file into a `Job`. An error names the file, the key, its value and what is allowed, in plain words.

Keys that a job sets and that cannot act, because another key switches off what they shape, are told, never ignored in silence.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from schemas.base import VALUE_KINDS, set_key, with_defaults
from schemas.dataset.layout import SWITCHES, is_stored
from schemas.errors import JobError, did_you_mean, plain_line
from schemas.job.assets import SOURCE_KINDS, offered_by, sources_of
from schemas.job.job import STUDIO, Job
from schemas.job.look import OF_COLOUR
from services.job.bounded_yaml import MOST_LEVELS, parse_yaml
from services.job.packed import is_packed, pack, unpack

MOST_BYTES = 250_000
"""Longest job file; the longest example has 2,000 bytes."""

MOST_KEYS = 20_000
"""Most keys and values of a job file: half of what a text may have, because filling in defaults adds more."""

MOST_KEY_CHARACTERS = 400
"""Longest path of a key in `--set`."""

MOST_FAULTS = 20
"""Most faults that one message tells."""

_WORDS: Mapping[str, str] = {
    kind: words
    for words, kinds in (
        ("must hold keys with values", ("model_type", "model_attributes_type", "dict_type")),
        ("must be a list: [a, b]", ("list_type", "tuple_type")),
        ("must be two numbers: [low, high]", ("named_tuple_type",)),
        ("must be a whole number", ("int_type", "int_parsing", "int_from_float")),
        ("must be a number", ("float_type", "float_parsing")),
        ("must be a finite number", ("finite_number",)),
        ("must be true or false", ("bool_type", "bool_parsing")),
        ("must be text: write it in quotes", ("string_type",)),
    )
    for kind in kinds
}
"""By the validator's kind of fault, in place of its own words, which name classes."""

_BOUNDS: Mapping[str, tuple[str, str]] = {
    "greater_than_equal": ("ge", "must be at least"),
    "greater_than": ("gt", "must be greater than"),
    "less_than_equal": ("le", "must be at most"),
    "less_than": ("lt", "must be less than"),
}


def describe_fault(fault: Any) -> str:
    """One line on a fault as pydantic tells it: the key's path, its value, and what is allowed."""
    words = [plain_line(str(part)) for part in _written(fault["loc"])]
    key = plain_line(".".join(words), 200)
    if fault["type"] == "extra_forbidden":
        allowed = allowed_keys(words)
        return f"{key}: there is no such key; {did_you_mean(words[-1], allowed)}Allowed here: {', '.join(allowed) or 'nothing'}"
    if fault["type"] == "missing":
        return f"{key}: is missing{'' if words[-1].isdigit() else ', and has no default'}"
    message = plain_line(_message(fault), 300)
    if not words:
        return message  # of several keys, which it names
    return f"{key}: {plain_line(repr(fault['input']))}: {message[:1].lower()}{message[1:]}"


def allowed_keys(path: Sequence[str]) -> list[str]:
    """Names of the keys that are siblings of a path's last part; the path may hold positions in lists."""
    models: list[type[BaseModel]] = [Job]
    for name in (part for part in path[:-1] if not part.isdigit()):
        fields = [model.model_fields[name] for model in models if name in model.model_fields]
        models = [branch for field in fields for branch in models_in(field.annotation)]
    return sorted({name for model in models for name in model.model_fields})


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models in the annotation of a key."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        return
    for argument in get_args(annotation):
        yield from models_in(argument)


def _message(fault: Any) -> str:
    kind, context = fault["type"], fault.get("ctx", {})
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        return f"{words} {context[name]:g}"
    if kind == "union_tag_not_found":
        return f"must have a key {context['discriminator']}"
    if kind == "union_tag_invalid":
        return f"its {context['discriminator']} {_one_of(context['tag'], context['expected_tags'])}"
    if kind == "literal_error":
        return _one_of(fault["input"], context["expected"])
    if kind == "too_short":
        return f"must have at least {context['min_length']} of them"
    if kind == "too_long":
        return f"must have at most {context['max_length']} of them"
    return str(_WORDS.get(kind, fault["msg"].removeprefix("Value error, ")))


def _one_of(given: object, allowed: str) -> str:
    """`allowed` as pydantic lists it: 'a', 'b' or 'c'."""
    known = [word.strip("'") for word in allowed.replace(" or ", ", ").split(", ")]
    return f"{did_you_mean(str(given), known)}must be {allowed}"


def _written(place: Sequence[str | int]) -> list[str | int]:
    """The parts of a place that the job file has: neither the kind of a source or a value, nor pydantic's mark of a map's key."""
    marks = (*VALUE_KINDS, "[key]")
    kinds = [(before, part) for before, part in zip((None, *place), place, strict=False) if part not in marks]
    return [part for before, part in kinds if not (isinstance(before, int) and part in SOURCE_KINDS)]


def load_job(path: Path, changes: Sequence[str] = ()) -> Job:
    """Read a job file, or a packed one, and apply `path.to.key=value` changes. Raises JobError."""
    name = name_of(path)
    job = validate_job(with_usual_colours(read_tree(path, changes)), name)
    _check_homes(job, name)
    if is_packed(str(path)):
        _check_absolute(job, name)
    return job


def with_usual_colours(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a new job, whose built-in objects have the colours of packaging unless it says otherwise.

    The record of a job made before there was `look.recolour` has no such key, and its objects are as they were made.
    """
    return with_defaults(tree, {"look.recolour": "packaging"} if offered_by(sources_of(tree)) else {})


def pack_job(path: Path) -> str:
    """A job file as one word, for the command line of another machine. Raises JobError as `load_job`."""
    if is_packed(str(path)):
        raise JobError(f"{name_of(path)}: is packed already")
    _check_absolute(load_job(path), name_of(path))
    try:
        return pack(path.read_bytes())
    except JobError as error:
        raise JobError(f"{name_of(path)}: {error}") from error


def name_of(path: Path) -> str:
    """What a message calls a job file."""
    return "the packed job" if is_packed(str(path)) else plain_line(str(path), 300)


def paths_of(job: Job) -> dict[str, str]:
    """Every folder and file that the job names, by its key."""
    sources = {
        f"assets.{branch}.{number}.folder": getattr(source, "folder", "")
        for branch in ("objects", "tables")
        for number, source in enumerate(getattr(job.assets, branch))
    }
    folders, around = job.captures.folders if job.captures is not None else [], job.look.environment
    named: dict[str, str | None] = {f"captures.folders.{number}": name for number, name in enumerate(folders)}
    named |= {f"cameras.more.{number}.poses": entry.poses for number, entry in enumerate(job.cameras.more)}
    named |= {"look.environment.folder": around.folder if around else None, "scenes_from": job.scenes_from}
    return sources | job.look.folders | {key: path for key, path in named.items() if path}


def refuse_folders(job: Job, name: str, fits: Callable[[str], bool], why: str) -> None:
    """Raises JobError for a folder of the job that does not fit where the job is to run; `told` says why, and the remedy."""
    from workers.assets.library.making import PYBULLET_DATA

    for key, folder in paths_of(job).items():
        if folder not in ("", PYBULLET_DATA) and not fits(folder):
            raise JobError(f"{name}: {key}: {plain_line(repr(folder))}: {why}")


def _check_absolute(job: Job, name: str) -> None:
    """Raises JobError for a folder that is meant from the job file's own, which a packed job has not."""
    why = "a packed job has no folder of its own: write the whole path, the same on every node"
    refuse_folders(job, name, lambda folder: folder.startswith(("/", "~")), why)


def _check_homes(job: Job, name: str) -> None:
    """Raises JobError for a folder that begins with the name of a user whom this machine does not know."""
    for key, folder in paths_of(job).items():
        try:
            Path(folder).expanduser()
        except RuntimeError as error:
            raise JobError(f"{name}: {key}: {plain_line(repr(folder))}: there is no such user") from error


def read_tree(path: Path, changes: Sequence[str] = ()) -> dict[str, Any]:
    """The keys of a job file with `path.to.key=value` changes, without defaults. Raises JobError."""
    name = name_of(path)
    try:
        tree = parse_yaml(read_text(path), MOST_KEYS)
    except FileNotFoundError as error:
        raise JobError(f"{name}: no such file; the examples are in deploy/jobs/") from error
    except (OSError, ValueError) as error:
        raise JobError(f"{name}: cannot be read as UTF-8 text: {plain_line(str(error), 200)}") from error
    except JobError as error:
        raise JobError(f"{name}: {error}") from error
    if not isinstance(tree, dict):
        kind = type(tree).__name__ if tree is not None else "nothing"
        raise JobError(f"{name}: holds {kind}, and must hold keys and values")
    if sum(map(len, changes)) > MOST_BYTES:
        raise JobError(f"--set: the changes have over {MOST_BYTES} characters: put them into the job file")
    for change in changes:
        change_key(tree, change)
    return tree


def read_text(path: Path) -> str:
    """The text of a file, of which no more is read than a job file may have. Raises OSError, ValueError, JobError."""
    if is_packed(str(path)):
        data = unpack(str(path), MOST_BYTES)
    else:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise JobError(f"has over {MOST_BYTES} bytes, and no job needs as many")
    return data.decode("utf-8-sig")


def change_key(tree: dict[str, Any], change: str) -> None:
    """Apply one `path.to.key=value` in place; the value is read as YAML. Raises JobError."""
    path, equals, text = change.partition("=")
    name = f"--set {plain_line(change, 120)}"
    if not equals or not path:
        raise JobError(f"{name}: write it as path.to.key=value, for example --set physics.step_hz=480")
    if len(path) > MOST_KEY_CHARACTERS or path.count(".") >= MOST_LEVELS:
        bounds = f"{MOST_LEVELS} parts or {MOST_KEY_CHARACTERS} characters"
        raise JobError(f"{name}: there is no such key: none has over {bounds}")
    try:
        set_key(tree, path, parse_yaml(text))
    except (JobError, ValueError) as error:
        raise JobError(f"{name}: {plain_line(str(error), 300)}") from error


def validate_job(tree: dict[str, Any], name: str) -> Job:
    """A `Job` from parsed keys. Raises JobError with one line for each fault."""
    version = tree.get("verso", 1)
    if isinstance(version, int) and version > 1:
        newer = f"{plain_line(str(version))} is newer than this program, which reads version 1: install a newer Verso"
        raise JobError(f"{name}: verso: {newer}")
    try:
        return Job.model_validate(tree)
    except ValidationError as error:
        faults = error.errors()
        # An invalid item of a list makes the list itself count as too short: that line would confuse.
        shown = [fault for fault in faults if fault["type"] != "too_short" or len(faults) == 1]
        lines = [f"{name}: {describe_fault(fault)}" for fault in shown[:MOST_FAULTS]]
        if len(shown) > MOST_FAULTS:
            lines.append(f"{name}: and {len(shown) - MOST_FAULTS} faults more")
        raise JobError("\n".join(lines)) from error


Acts = Callable[[Job], bool]

_COLOUR, _MIRROR, _DEPTH, _PROJECTION = (
    (f"{SWITCHES[part]} is false", partial(is_stored, part)) for part in ("rgb", "mirror", "aligned", "projected")
)
_SEVERAL: tuple[str, Acts] = ("objects_per_scene is 1", lambda job: job.objects_per_scene.high > 1)
_PILE: tuple[str, Acts] = ("start.arrange is spread", lambda job: job.start.arrange == "pile")
_RASTER: tuple[str, Acts] = ("render.tier is not raster", lambda job: job.render.tier == "raster")
_TRACED: tuple[str, Acts] = ("render.tier is not pathtraced", lambda job: job.render.tier == "pathtraced")
_PARTS: tuple[str, Acts] = (
    "physics.collision makes no convex parts",
    lambda job: job.physics.collision in ("planned", "parts"),
)

NEEDS: dict[str, tuple[tuple[str, Acts], ...]] = {
    "render.tier": (_COLOUR,),
    "render.samples": (_COLOUR, _RASTER),
    "render.path_samples": (_COLOUR, _TRACED),
    "render.path_bounces": (_COLOUR, _TRACED),
    "cameras.mirror.T_z_m": (_MIRROR,),
    "cameras.mirror.percentile": (_MIRROR,),
    "cameras.depth.offset_m": (_DEPTH,),
    "images.projection.splat": (_PROJECTION,),
    "images.projection.hidden_point_removal": (_PROJECTION,),
    "start.arrange": (_SEVERAL,),
    "start.pile_offset_m": (_SEVERAL, _PILE),
    "physics.concavity": (_PARTS,),
    **{f"look.{name}": (_COLOUR, ("render.tier is flat", lambda job: job.render.tier != "flat")) for name in OF_COLOUR},
    "studio.size_m": (("studio.scale is metric", lambda job: job.studio.scale != "metric"),),
}
"""Keys of scenes by what must hold for them to act: a phrase for where it does not, and whether it does."""


OF_SCENES = {
    "cameras.orbit": "captures.simulate.distance_m and inclination_rad",
    "cameras.sensor": "captures.simulate.image_scale",
    "start": "",
    "physics": "",
    "render": "captures.simulate.tier",
}
"""Branches of keys that a capture has not, and what a virtual one has in their place."""


def describe_idle(job: Job) -> list[str]:
    """A line for each key that has another value than its default and cannot act."""
    if job.captures is not None:
        lines = []
        for branch, instead in OF_SCENES.items():
            why = "photographs show what they show" if job.captures.folders else f"a virtual capture has {instead}"
            why = why if instead else "nothing falls in a capture"
            names = ["tier"] if branch == "render" else type(_branch(job, branch)).model_fields
            lines += [_idle(job, f"{branch}.{name}", why) for name in names]
    else:
        unmet = {key: next((phrase for phrase, acts in needs if not acts(job)), None) for key, needs in NEEDS.items()}
        lines = [_idle(job, key, why) for key, why in unmet.items() if why is not None]
    return [line for line in lines if line]


def _branch(job: Job, branch: str) -> BaseModel:
    model: BaseModel = reduce(getattr, branch.split("."), job)
    return model


def _idle(job: Job, key: str, why: str) -> str:
    """The line on a key that cannot act; empty where it has its default."""
    branch, _, name = key.rpartition(".")
    model = _branch(job, branch)
    value, usual = getattr(model, name), type(model).model_fields[name].get_default(call_default_factory=True)
    usual = STUDIO.get(key, usual) if job.scene == "studio" else usual
    given = "given" if isinstance(value, BaseModel) else value
    return "" if value == usual else f"{key} is {given} and has no effect: {why}"

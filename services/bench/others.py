"""The other systems that make the same scenes. A new one is a module that answers lines, and a row in `SIDES`.

Such a module is a process of its own. It says `{"ready": true}`, then reads one line of JSON for each scene (`scene`: the
`scene.json` that handover.py wrote beside its meshes; `out`: a folder; and the items of `asked` in its row) and answers
with one line: `wall_s`, `cpu_s`, `stages_s` by stage, and `load_s`, the seconds of reading files before its clock.
`answer_scenes` in answers.py does that.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version

from schemas.job.job import Job


@dataclass(frozen=True)
class Side:
    """One other system: its name in JSON and in the text, what it makes, its module, and the package that it needs."""

    name: str
    title: str
    makes: str
    module: str
    asked: Mapping[str, str] = field(default_factory=dict)
    package: str | None = None
    only_raster: bool = False
    """Whether its images are comparable with those of the raster tier only."""


SIDES = (
    Side(
        "script_plain",
        "the script, plain look",
        "same files; RGB with a floor of one colour, one light, no shadows",
        "services.bench.baseline",
        {"look": "plain"},
    ),
    Side(
        "script_same_look",
        "the script, same look",
        "same files; RGB with the floor's texture, the scene's lights and pyrender's shadows",
        "services.bench.baseline",
        {"look": "same"},
        only_raster=True,
    ),
    Side(
        "mujoco",
        "MuJoCo",
        "physics and 3 views in memory; no textures, no projection, no patches, no files",
        "services.bench.mujoco_side",
        package="mujoco",
    ),
)

ELSEWHERE = {"Blender Cycles": "bpy"}
"""Systems without a row here, and the package of each."""


def sides_of(job: Job) -> list[Side]:
    """The systems that can make a job's scenes on this machine."""
    comparable = [side for side in SIDES if job.render.tier == "raster" or not side.only_raster]
    return [side for side in comparable if side.package is None or installed(side.package)]


def other_systems() -> dict[str, str]:
    """Versions of the optional systems by name, `not installed` for those that are not. Imports nothing."""
    packages = {side.title: side.package for side in SIDES if side.package is not None} | ELSEWHERE
    return {title: installed(package) or "not installed" for title, package in packages.items()}


def installed(package: str) -> str | None:
    """Version of a package, None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None

"""The job file: one tree of frozen models, parsed once. A step gets its own branch and no other.

Every key has a default except `name`; `extra = forbid` everywhere, so a misspelt key is an error and not a silence.
Keys under `run`, and `scenes`, do not change what a scene is: they are outside its settings digest.
"""

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from schemas.base import Frozen, NonNegativeInt, Positive, PositiveInt
from schemas.job.assets import Assets
from schemas.job.cameras import Cameras
from schemas.job.images import Images
from schemas.job.physics import Physics
from schemas.job.preset import PresetName, with_preset
from schemas.job.render import Render
from schemas.job.run import Check, Output, Run
from schemas.job.sensor import SensorEffects
from schemas.job.start import ONE_OBJECT, ObjectCount, Start

Category = Literal["bottle", "camera", "can", "jar", "laptop", "mug", "bowl", "box"]
CATEGORIES: tuple[Category, ...] = ("bottle", "camera", "can", "jar", "laptop", "mug", "bowl", "box")


class Job(Frozen):
    """A whole job file."""

    verso: Literal[1] = 1
    """schema_version."""
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    """Names the dataset; the default output folder is data/<name>."""
    preset: PresetName = "balanced"
    """What keys that are not given are: `fast` and `exact` trade errors for time as docs/tradeoff has measured."""
    seed: NonNegativeInt = 0
    """Seed of everything that is drawn in a scene."""
    scenes: PositiveInt = 64
    """How many scenes; more than before extends a dataset."""
    first_scene: NonNegativeInt = 0
    """Id of the first scene."""
    pairs_per_scene: Annotated[int, Field(ge=1, le=1000)] = 1
    """Input and mirror poses of each scene."""
    objects_per_scene: ObjectCount = ONE_OBJECT
    """How many objects lie on the table; a range is drawn from, each number alike. The scene's category is the first's."""
    categories: dict[Category, Positive] = Field(default_factory=lambda: dict.fromkeys(CATEGORIES, 1.0), min_length=1)
    """Weights; a list of names means equal weights."""
    assets: Assets = Assets()
    """Where shapes come from."""
    start: Start = Start()
    """How an object begins."""
    physics: Physics = Physics()
    """How it comes to rest."""
    cameras: Cameras = Cameras()
    """Who looks at it."""
    images: Images = Images()
    """What is stored."""
    render: Render = Render()
    """How RGB looks."""
    sensor: SensorEffects = SensorEffects()
    """What the sensors add to exact images; nothing by default."""
    check: Check = Check()
    """What is checked before a scene is committed."""
    output: Output = Output()
    """How files are laid out."""
    run: Run = Run()
    """How the work is driven: changes no byte of the dataset."""

    @model_validator(mode="before")
    @classmethod
    def _fill(cls, value: object) -> object:
        return with_preset(value) if isinstance(value, dict) else value

    @field_validator("categories", mode="before")
    @classmethod
    def _from_list(cls, value: object) -> object:
        if isinstance(value, list):
            if len(set(map(str, value))) != len(value):
                raise ValueError(f"{value} names a category twice")
            return dict.fromkeys(value, 1.0)
        return value

    @model_validator(mode="after")
    def _agrees(self) -> "Job":
        if self.images.projection.enabled and not self.cameras.mirror.enabled:
            raise ValueError(
                "images.projection.enabled is true and cameras.mirror.enabled is false: what is projected is what the "
                "mirror camera would see; set images.projection.enabled: false too"
            )
        if self.sensor.changes_rgb and not self.render.rgb:
            raise ValueError(
                "render.rgb is false and sensor asks for an effect on RGB: leave out sensor.distortion, sensor.rgb_noise "
                "and sensor.exposure"
            )
        return self

    @property
    def stop_scene(self) -> int:
        """One past the last scene id."""
        return self.first_scene + self.scenes

"""The branch `look` of a job: light and surroundings of a scene. They change colour, and what else stands in a picture."""

from schemas.base import Frozen


class Look(Frozen):
    """Light and surroundings; every branch is off unless asked for, and what is off leaves the scene as it was."""

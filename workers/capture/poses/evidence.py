"""What the three estimates of a capture are made from."""

from dataclasses import dataclass

from schemas.capture.view import CaptureCamera
from schemas.job.captures import Board, Estimation
from workers.capture.poses.markers import MarkerPose, measured_corner_px
from workers.capture.poses.observation import Observation, Setup


@dataclass(frozen=True, eq=False)
class Evidence:
    """The views of a capture in order of number, each with its pose from markers; corner_px: measured sigma of a corner."""

    setup: Setup
    observations: tuple[Observation, ...]
    markers: tuple[MarkerPose, ...]
    corner_px: float

    @staticmethod
    def of(setup: Setup, observations: list[Observation], markers: list[MarkerPose]) -> "Evidence":
        """With the sigma of a corner measured over all views."""
        return Evidence(setup, tuple(observations), tuple(markers), measured_corner_px(markers, setup.spec))

    @property
    def camera(self) -> CaptureCamera:
        """The colour camera."""
        return self.setup.camera

    @property
    def board(self) -> Board:
        """The board as board.json has it."""
        return self.setup.board

    @property
    def spec(self) -> Estimation:
        """How poses are estimated."""
        return self.setup.spec

"""How a model is verified."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from pisigma.files.setting import HIDDEN
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.workflow.settings.calibration import SocketDistances

if TYPE_CHECKING:
    from pisigma.validation.held_out.frames.fitted_frames import FrameKind


@dataclass(frozen=True)
class VerificationSettings:
    """How a model is verified.

    Attributes:
        fit_frame: the sensor was moved since: fit its frame to these rows, 6 poses or more.
        fit_tool: another reflector was mounted since: fit its place to these rows, 6 poses or more.
        seed: of the resamples for confidence intervals.
        cameras: what the pixels mean where the file holds corners of boards in images.
        socket_distances: known distances of two sockets [m]; */0,*/1,50 states 50 mm for every placement, as * in both
            names stands for the same text.
    """

    fit_frame: bool = False
    fit_tool: bool = False
    seed: Annotated[int, HIDDEN] = 0
    cameras: CameraFiles | None = None
    socket_distances: SocketDistances = field(default_factory=dict)

    @property
    def fitted(self) -> "tuple[FrameKind, ...]":
        """What is fitted to the rows."""
        from pisigma.validation.held_out.frames.fitted_frames import fitted_kinds

        return fitted_kinds(self.fit_frame, self.fit_tool)

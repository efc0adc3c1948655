"""Settings of a verification."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from pisigma.files.setting import HIDDEN
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.workflow.settings.calibration import SocketDistances

if TYPE_CHECKING:
    from pisigma.validation.held_out.frames.fitted_frames import FrameKind


@dataclass(frozen=True)
class VerificationSettings:
    """Settings of a verification.

    Attributes:
        fit_frame: fit the frame of the sensor to these rows, for example after it was moved. Requires 6 poses or more.
        fit_tool: fit the position of the reflector to these rows, for example after it was replaced. Requires 6 poses
            or more.
        seed: random seed of the resamples for confidence intervals.
        cameras: cameras and boards, for files of detected board corners.
        socket_distances: known distances [m] by the names of two sockets, such as {("*/0", "*/1"): 0.05}. An asterisk
            stands for the same text in both names, here for every placement.
    """

    fit_frame: bool = False
    fit_tool: bool = False
    seed: Annotated[int, HIDDEN] = 0
    cameras: CameraFiles | None = None
    socket_distances: SocketDistances = field(default_factory=dict)

    @property
    def fitted_kinds(self) -> "tuple[FrameKind, ...]":
        """Frames that are fitted to the rows."""
        from pisigma.validation.held_out.frames.fitted_frames import fitted_kinds

        return fitted_kinds(self.fit_frame, self.fit_tool)

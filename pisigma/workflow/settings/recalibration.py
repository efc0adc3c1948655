"""Settings of a recalibration."""

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pisigma.files.errors import IdentificationError, check_choice
from pisigma.files.setting import NAMES
from pisigma.measurement.camera.camera_files import CameraFiles

if TYPE_CHECKING:
    from pisigma.validation.held_out.frames.fitted_frames import FrameKind

Moved = Annotated[tuple[str, ...] | None, NAMES]


@dataclass(frozen=True)
class RecalibrationSettings:
    """Settings of a recalibration.

    Attributes:
        moved: what was moved after the model was made: base, tool or base,tool (empty: neither). None: detected from
            the rows.
        cameras: cameras and boards, for files of detected board corners.

    Raises:
        IdentificationError: `moved` names something else.
    """

    moved: Moved = None
    cameras: CameraFiles | None = None

    def command(self, model: str, data: str) -> str:
        """Return the command line that recalibrates a model with a file and these settings."""
        stated = [] if self.moved is None else ["--moved", ",".join(self.moved)]
        stated += self.cameras.options if self.cameras else []
        return shlex.join(["pisigma", "recalibrate", model, data, *stated, "--out", "DIR"])

    @property
    def fitted_kinds(self) -> "tuple[FrameKind, ...]":
        """Frames that were moved, as stated."""
        from pisigma.validation.held_out.frames.fitted_frames import fitted_kinds

        return fitted_kinds("base" in (self.moved or ()), "tool" in (self.moved or ()))

    def __post_init__(self) -> None:
        """Check `moved`."""
        for name in self.moved or ():
            check_choice(IdentificationError, "moved", name, ("base", "tool"))

"""How a model is recalibrated."""

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pisigma.files.errors import IdentificationError, nearest_choice
from pisigma.files.setting import NAMES
from pisigma.measurement.camera.camera_files import CameraFiles

if TYPE_CHECKING:
    from pisigma.validation.held_out.frames.fitted_frames import FrameKind

Moved = Annotated[tuple[str, ...] | None, NAMES]


@dataclass(frozen=True)
class RecalibrationSettings:
    """How a model is recalibrated.

    Attributes:
        moved: what stands elsewhere since the model was made: base, tool, or base,tool; nothing for neither. None: what
            the rows show.
        cameras: what the pixels mean where files of rows hold corners of boards in images.

    Raises:
        IdentificationError: something else is named.
    """

    moved: Moved = None
    cameras: CameraFiles | None = None

    def command(self, model: str, data: str) -> str:
        """The line that recalibrates a model with a file in this way."""
        stated = [] if self.moved is None else ["--moved", ",".join(self.moved)]
        stated += self.cameras.options if self.cameras else []
        return shlex.join(["pisigma", "recalibrate", model, data, *stated, "--out", "DIR"])

    @property
    def fitted(self) -> "tuple[FrameKind, ...]":
        """What is stated to stand elsewhere."""
        from pisigma.validation.held_out.frames.fitted_frames import fitted_kinds

        return fitted_kinds("base" in (self.moved or ()), "tool" in (self.moved or ()))

    def __post_init__(self) -> None:
        """Refuse what cannot stand elsewhere."""
        for name in self.moved or ():
            if name not in ("base", "tool"):
                raise IdentificationError(
                    f"moved: '{name}' is no choice; {nearest_choice(name, ('base', 'tool'))}"
                )

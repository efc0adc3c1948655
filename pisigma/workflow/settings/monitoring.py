"""How sessions of a robot are judged."""

from dataclasses import dataclass
from operator import not_
from typing import Annotated

from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.files.setting import Option, names
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.dates import WANTED, is_date
from pisigma.workflow.settings.recalibration import Moved, RecalibrationSettings


@dataclass(frozen=True)
class MonitorSettings:
    """How sessions are judged.

    Attributes:
        dates: days of the files, one each, such as 2026-10-01,2026-11-01. None: column date, name of the file, its
            change.
        moved: what stands elsewhere since the model was made: base, tool, or base,tool; nothing for neither. None: what
            the rows show.
        limit_mm: RMS error to stay below [mm]; says when it will be passed.
        history: MODEL.history.sqlite keeps the sessions of every call; without a history it is neither read nor
            written.
        cameras: what the pixels mean where files hold corners of boards in images.

    Raises:
        IdentificationError: something else is named in `moved`, or the limit is no length.
        MeasurementError: a date is none.
    """

    dates: Annotated[tuple[str, ...], Option(kind=str, read=names, metavar="DAY,...")] = ()
    moved: Moved = None
    limit_mm: float | None = None
    history: Annotated[bool, Option("--no-history", kind=bool, read=not_)] = True
    cameras: CameraFiles | None = None

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        RecalibrationSettings(self.moved)
        for date in self.dates:
            if not is_date(date):
                raise MeasurementError(f"dates: expected {WANTED}, got '{date}'; correct it.")
        if self.limit_mm is not None and not self.limit_mm > 0:
            raise IdentificationError(
                f"limit_mm: a length above 0 was wanted, got {self.limit_mm:g}; give the RMS error to stay below."
            )

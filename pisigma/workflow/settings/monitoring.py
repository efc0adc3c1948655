"""Settings for monitoring a robot."""

from dataclasses import dataclass
from operator import not_
from typing import Annotated

from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.files.setting import Option, split_names
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.dates import EXPECTED_DATE, is_date
from pisigma.workflow.settings.recalibration import Moved, RecalibrationSettings


@dataclass(frozen=True)
class MonitorSettings:
    """Settings for monitoring a robot.

    Attributes:
        dates: date of each file, such as 2026-10-01,2026-11-01. None: from the date column, otherwise from the
            file name, otherwise from the modification time.
        moved: what was moved after the model was made: base, tool or base,tool (empty: neither). None: detected from
            the rows.
        limit_mm: limit on the RMS error [mm]; the date on which it will be exceeded is predicted.
        history: read and write the history of the model, which stores the sessions of all calls.
        cameras: cameras and boards, for files of detected board corners.

    Raises:
        IdentificationError: `moved` names something else, or the limit is not positive.
        MeasurementError: a date is not valid.
    """

    dates: Annotated[tuple[str, ...], Option(kind=str, read=split_names, metavar="DAY,...")] = ()
    moved: Moved = None
    limit_mm: float | None = None
    history: Annotated[
        bool,
        Option(
            "--no-history",
            kind=bool,
            read=not_,
            help="Do not read or write the model's history, which contains the sessions of all earlier runs.",
        ),
    ] = True
    cameras: CameraFiles | None = None

    def __post_init__(self) -> None:
        """Check `moved`, the dates and the limit."""
        RecalibrationSettings(self.moved)
        for date in self.dates:
            if not is_date(date):
                raise MeasurementError(
                    expected=EXPECTED_DATE, value=date, option="dates", remedy="correct the date"
                )
        if self.limit_mm is not None and not self.limit_mm > 0:
            raise IdentificationError(expected="an RMS error > 0 mm", value=self.limit_mm, option="limit_mm")

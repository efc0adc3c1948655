"""Settings for importing exports of instruments and controllers."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pisigma.files.errors import MeasurementError, check_choice
from pisigma.files.setting import Option

if TYPE_CHECKING:
    from pisigma.measurement.foreign.dialect import Decimal
    from pisigma.measurement.foreign.joining import JoinBy
    from pisigma.measurement.foreign.lerobot_motors import LeRobotUnits

_SIGNS = {"point": ".", "comma": ","}


def parse_maps(text: str) -> Sequence[Mapping[str, str]]:
    """Return column mappings from text or from a file."""
    from pisigma.measurement.foreign.saved_map import parse_map

    return parse_map(text)


def parse_seconds(text: str) -> float:
    """Return the seconds of a duration such as "0.2s" or "200ms"."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(s|ms)?\s*", text)
    if match is None:
        raise MeasurementError(expected="a duration such as 0.2s or 200ms", value=text, option="--within")
    return float(match[1]) * (1e-3 if match[2] == "ms" else 1.0)


@dataclass(frozen=True)
class ImportSettings:
    """Settings for importing exports of instruments and controllers.

    Attributes:
        maps: meaning of the columns, such as A1=q1_deg,X=x_mm,note=-, or a file written by --save-map. Columns are
            named by heading or by number (from 1). Meanings are a column of measurement files (q1_deg), its quantity in
            another unit (x_in) or in the unit stated in the file (x), a value of a rotation (ur_rx_rad), point, time,
            or - for a column to skip. A - before a meaning reverses the sign (-q4_deg), a ! after it overrules the unit
            stated in the file (x_in!). If several mappings are given, the one that fits is used for each file.
        units: units of the columns for which the file states none, such as mm,deg or m,rad.
        rotation: maker whose rotation convention applies, such as kuka or ur, or none to skip rotations. None: from the
            headings.
        decimal: decimal separator, point or comma on a command line. None: detected from the values in the file.
        join: how to join joint values of one file with measurements of another: by point, order or time. None:
            the files are concatenated.
        within: maximum difference between joined time stamps [s].
        new_frame_at: first line measured after the instrument was moved; the rows from there on are in a new frame.
        lerobot_units: units of the joint values of a LeRobot data set, degrees or normalized (-100 to 100).
        lerobot_calibration: calibration file of LeRobot with which normalized values were recorded.
        lerobot_prefix: prefix of the motor names of this arm in a LeRobot data set with two arms, such as left_.

    Raises:
        MeasurementError: `join` or `lerobot_units` is not a valid choice.
    """

    maps: Annotated[Sequence[Mapping[str, str]], Option("--map", kind=str, read=parse_maps)] = ()
    units: Annotated[str, Option("--unit")] = ""
    rotation: str | None = None
    decimal: Annotated[
        "Decimal | None", Option(kind=Literal["point", "comma"], read=_SIGNS.get, is_key_only=True)
    ] = None
    join: Annotated["JoinBy | None", Option(kind=str)] = None
    within: Annotated[float, Option(kind=str, read=parse_seconds, default="0.2s")] = 0.2
    new_frame_at: Annotated[tuple[int, ...], Option(metavar="LINE", is_key_only=True)] = ()
    lerobot_units: Annotated["LeRobotUnits | None", Option(kind=str, is_key_only=True)] = None
    lerobot_calibration: Annotated[str | None, Option(is_key_only=True)] = None
    lerobot_prefix: Annotated[str, Option(is_key_only=True)] = ""

    def __post_init__(self) -> None:
        """Check the choices."""
        from pisigma.measurement.foreign.joining import JoinBy

        if self.join is not None:
            check_choice(MeasurementError, "join", self.join, get_args(JoinBy))
        if self.lerobot_units is not None:
            from pisigma.measurement.foreign.lerobot_motors import LeRobotUnits

            check_choice(MeasurementError, "lerobot_units", self.lerobot_units, get_args(LeRobotUnits))

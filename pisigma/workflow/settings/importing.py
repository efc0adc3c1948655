"""How exports are read."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pisigma.files.errors import MeasurementError, check_choice
from pisigma.files.setting import Option

if TYPE_CHECKING:
    from pisigma.measurement.foreign.dialect import Decimal
    from pisigma.measurement.foreign.joining import JoinBy

_SIGNS = {"point": ".", "comma": ","}


def stated_map(stated: str) -> Sequence[Mapping[str, str]]:
    """Mappings of columns, from text or a file."""
    from pisigma.measurement.foreign.saved_map import parse_map

    return parse_map(stated)


def seconds(stated: str) -> float:
    """Seconds of a duration such as 0.2s or 200ms."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(s|ms)?\s*", stated)
    if match is None:
        raise MeasurementError(f"--within {stated}: a duration was wanted, such as 0.2s or 200ms.")
    return float(match[1]) * (1e-3 if match[2] == "ms" else 1.0)


@dataclass(frozen=True)
class ImportSettings:
    """How exports are read.

    Attributes:
        maps: what columns are, by headings or numbers from 1 on, such as A1=q1_deg,X=x_mm,note=-, or a file that
            --save-map wrote: a column of measurement files (q1_deg), such a quantity in another unit (x_in) or in that
            which the file states (x), a value of a rotation (ur_rx_rad), point, time, or - for a column that is not
            wanted. Of several the one that fits a file counts.
        units: units of columns for which the file states none, such as mm,deg or m,rad.
        rotation: maker whose rotations these are, such as kuka or ur; none leaves them out. None: by the headings.
        decimal: sign before decimals, on a command line point or comma. None: by the cells.
        join: by what joint values of one file and measurements of another are put together: point, order or time. None:
            the files stand behind each other.
        within: time stamps that are put together differ by no more [s].

    Raises:
        MeasurementError: there is no such way to join.
    """

    maps: Annotated[Sequence[Mapping[str, str]], Option("--map", kind=str, read=stated_map)] = ()
    units: Annotated[str, Option("--unit")] = ""
    rotation: str | None = None
    decimal: Annotated["Decimal | None", Option(kind=Literal["point", "comma"], read=_SIGNS.get)] = None
    join: Annotated["JoinBy | None", Option(kind=str)] = None
    within: Annotated[float, Option(kind=str, read=seconds, default="0.2s")] = 0.2

    def __post_init__(self) -> None:
        """Refuse what is no way to join."""
        from pisigma.measurement.foreign.joining import JoinBy

        if self.join is not None:
            check_choice(MeasurementError, "join", self.join, get_args(JoinBy))

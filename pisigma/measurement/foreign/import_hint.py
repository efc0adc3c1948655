"""What to say of a file that is no measurement file, but that `pisigma import` reads."""

import os
import shlex

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.columns import CORNERS, find_column
from pisigma.measurement.csv.table import read_table
from pisigma.measurement.foreign.export_file import read_export
from pisigma.measurement.foreign.mapping import FileMapping, map_columns
from pisigma.measurement.foreign.quantities import KEYS

_MOST_BYTES = 2**22
"""Of a file that is looked at, so that a refusal does not take long."""


def import_hint(path: str | os.PathLike[str]) -> str:
    """Give a sentence with the command that imports a file as an export; "" where none does.

    Args:
        path: a file whose table or header the reader of measurement files refused.
    """
    if _has_columns(path):
        return ""
    try:
        mapping = map_columns(read_export(path, most=_MOST_BYTES), {}, None, {})
    except MeasurementError:
        return ""
    is_half = (mapping.has_joints or mapping.has_measured) and set(KEYS) & set(mapping.quantities)
    if mapping.possible_joints or not (is_half or (mapping.has_joints and mapping.has_measured)):
        return ""
    return f" The command `{_command(mapping)}` would read it as an export."


def _has_columns(path: str | os.PathLike[str]) -> bool:
    """Whether the header of a file has the columns of measurement files or of corners; something else is wrong then."""
    try:
        header = read_table(path).header
        return set(CORNERS) <= set(header) or all(find_column(name) or name in CORNERS for name in header)
    except MeasurementError:
        return False


def _command(mapping: FileMapping) -> str:
    words = ["pisigma", "import", shlex.quote(mapping.file.source)]
    if not mapping.has_measured:
        words += ["MEASURED", "--join", "point"]
    elif not mapping.has_joints:
        words += ["JOINTS", "--join", "point"]
    if units := mapping.likely_units:
        words += ["--unit", ",".join(units.values())]
    if mapping.rotations:
        words += ["--rotation", "MAKER"]
    return " ".join([*words, "--out", "data.csv"])

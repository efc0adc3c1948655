"""CSV files that the folder of a calibrated model holds beside its card: parameters and correlations."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from pisigma.identification.identifiability.pairwise import CorrelationTable
from pisigma.judging.calibration_summary import ParameterFigures

PARAMETERS_CSV = "parameters.csv"
CORRELATION_CSV = "correlation.csv"

_FIGURES = ("nominal", "estimated", "change", "standard_error")


def write_parameters(parameters: Sequence[ParameterFigures], path: Path) -> None:
    """Write the parameter table in full digits; a cell is empty where there is no figure.

    Args:
        parameters: in mm and deg.
        path: the CSV to write.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["name", "unit", *_FIGURES, "remark"])
        for row in parameters:
            figures = (getattr(row, name) for name in _FIGURES)
            texts = ("" if value is None else repr(value) for value in figures)
            writer.writerow([row.name, row.unit, *texts, row.remark])


def write_correlations(tables: Sequence[CorrelationTable], path: Path) -> None:
    """Write the tables of lengths and of angles, a cell a line; an undefined correlation is an empty cell.

    Args:
        tables: of lengths and of angles.
        path: the CSV to write.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["of", "parameter", "with", "correlation"])
        for kind, table in zip(("lengths", "angles"), tables, strict=True):
            for name, values in zip(table.names, table.values.tolist(), strict=True):
                for other, value in zip(table.names, values, strict=True):
                    writer.writerow([kind, name, other, "" if math.isnan(value) else f"{value:.6f}"])

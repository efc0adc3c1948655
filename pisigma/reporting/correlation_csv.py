"""Correlations of the identification Jacobian's columns as a file in a model folder."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from pisigma.identification.identifiability.pairwise import CorrelationTable

CORRELATION_CSV = "correlation.csv"


def write_correlations(tables: Sequence[CorrelationTable], path: Path) -> None:
    """Write the tables of lengths and of angles, a cell a line; an unknown correlation is an empty cell.

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

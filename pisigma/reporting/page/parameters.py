"""What a model folder tells of the identified parameters: values, doubts, correlations, observability."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from pisigma.judging.calibration_summary import read_summary
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_files import CORRELATION_CSV
from pisigma.reporting.calibration_tables import (
    PARAMETER_COLUMNS,
    parameter_table,
    undetermined_lines,
    warning_lines,
)

STRONG = 0.9
"""Pairs of parameters with a larger correlation are named."""
MOST_PAIRS = 12
INDICES = (
    ("O1", "volume of what the rows tell of all parameters together, larger is better (Borm and Menq 1991)"),
    ("O2", "inverse of the condition number, 1 is best (Driels and Pathre 1990)"),
    ("O3", "the direction that is seen least, larger is better (Nahvi et al. 1994)"),
    (
        "O4",
        "noise amplification: the least direction weighed by O2, larger is better (Nahvi and Hollerbach 1996)",
    ),
    ("O5", "harmonic mean of how well directions are seen, larger is better (Sun and Hollerbach 2008)"),
)


@dataclass(frozen=True, eq=False)
class ParameterFindings:
    """What is said of parameters.

    Attributes:
        columns: of the table.
        table: its rows; empty for a model without identified geometry.
        estimated: number of parameters with a standard error.
        not_identified: in sentences.
        observability: name, value and meaning of every index; empty where they are not known.
        rank: independent combinations that the data see, or None.
        condition: condition number, or None.
        pairs: strongly correlated parameters and their correlation, strongest first.
        correlations: names and table of lengths and of angles; empty where they are not kept.
        missing: what the folder does not keep, in sentences.
    """

    columns: tuple[str, ...]
    table: tuple[tuple[str, ...], ...]
    estimated: int
    not_identified: tuple[str, ...]
    observability: tuple[tuple[str, float, str], ...]
    rank: int | None
    condition: float | None
    pairs: tuple[tuple[str, str, float], ...]
    correlations: tuple[tuple[tuple[str, ...], Float64[np.ndarray, "_names _names"]], ...]
    missing: tuple[str, ...]


def parameter_findings(model: CalibratedModel, folder: Path) -> ParameterFindings:
    """Gather it from the metrics of a model and the files of its folder."""
    summary = read_summary(model)
    tables = read_correlations(folder / CORRELATION_CSV)
    missing = []
    if summary is None:
        missing.append(
            "This model has no identified parameters: its geometry is the nominal one."
            if model.calibrated is None
            else "The model folder does not keep what was found of its parameters; calibrate again."
        )
    elif not tables:
        missing.append(
            "The model folder does not keep the correlations as numbers; calibrate again to have them."
        )
    if summary is None:
        return ParameterFindings(
            PARAMETER_COLUMNS, (), 0, (), (), None, None, _pairs(tables), tables, tuple(missing)
        )
    return ParameterFindings(
        columns=PARAMETER_COLUMNS,
        table=parameter_table(summary.parameters).rows,
        estimated=sum(row.standard_error is not None for row in summary.parameters),
        not_identified=(*undetermined_lines(summary), *warning_lines(summary)),
        observability=tuple((name, getattr(summary.observability, name), text) for name, text in INDICES),
        rank=summary.rank,
        condition=summary.condition_number,
        pairs=_pairs(tables),
        correlations=tables,
        missing=tuple(missing),
    )


def read_correlations(path: Path) -> tuple[tuple[tuple[str, ...], Float64[np.ndarray, "_names _names"]], ...]:
    """Read the tables of lengths and of angles; nothing where there is no such file, or it holds something else."""
    if not path.is_file():
        return ()
    found: dict[str, dict[tuple[str, str], float]] = {"lengths": {}, "angles": {}}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                value = float(row["correlation"]) if row["correlation"] else np.nan
                found[row["of"]][row["parameter"], row["with"]] = value
        tables = []
        for cells in found.values():
            names = tuple(dict.fromkeys(name for name, _ in cells))
            tables.append(
                (names, np.array([[cells[a, b] for b in names] for a in names]).reshape(len(names), -1))
            )
    except (KeyError, ValueError, TypeError, OSError):
        return ()
    return tuple(tables)


def _pairs(tables: tuple[tuple[tuple[str, ...], np.ndarray], ...]) -> tuple[tuple[str, str, float], ...]:
    found = []
    for names, values in tables:
        for i, name in enumerate(names):
            found += [(name, names[k], float(values[i, k])) for k in range(i) if abs(values[i, k]) >= STRONG]
    return tuple(sorted(found, key=lambda pair: -abs(pair[2]))[:MOST_PAIRS])

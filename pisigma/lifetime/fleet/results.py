"""Table of all checks of the cells of a fleet, as a Parquet file for DuckDB, pandas or Polars."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pisigma.files.output_file import write_atomically
from pisigma.lifetime.cell.facts import CellFacts

RESULTS = "results.parquet"
"""Name of the table in the folder of the cells."""


@dataclass(frozen=True)
class ParameterValue:
    """An estimated geometric parameter.

    Attributes:
        name: name such as "theta_1".
        unit: "mm" or "deg", of the three figures.
        value: identified value.
        change: difference from the nominal value.
        standard_error: standard error of the estimate.
    """

    name: str
    unit: str
    value: float
    change: float
    standard_error: float


Parameters = Mapping[str, Sequence[ParameterValue]]
"""Estimated parameters of models by the SHA-256 of their `model.yaml`."""


def read_parameters(path: Path) -> Parameters:
    """Read the parameters of the models in a table; empty if there is no table, or it cannot be read."""
    from pyarrow import ArrowException, parquet

    try:
        table = parquet.read_table(path, columns=["model_sha256", "parameters"]).to_pylist()
    except (OSError, ArrowException):
        return {}
    return {
        row["model_sha256"]: [ParameterValue(**one) for one in row["parameters"]]
        for row in table
        if row["parameters"]
    }


def write_results(path: Path, cells: Sequence[CellFacts], parameters: Parameters) -> None:
    """Write one row for every check of every cell; the row of a new model has its parameters.

    Args:
        path: file to write.
        cells: facts about the cells.
        parameters: estimated parameters of the models.

    Raises:
        OutputError: the file cannot be written; an existing one is kept.
        ImportError: pyarrow is not installed.
    """
    import pyarrow
    from pyarrow import parquet

    text, number = pyarrow.string(), pyarrow.float64()
    estimates = ((name, number) for name in ("value", "change", "standard_error"))
    parameter = pyarrow.struct([("name", text), ("unit", text), *estimates])
    schema = pyarrow.schema(
        [
            *((name, text) for name in ("cell", "command", "session", "day")),
            ("rows", pyarrow.int64()),
            ("temperature_c", number),
            *((name, text) for name in ("model", "model_sha256", "verdict", "summary")),
            ("rms_mm", number),
            ("p95_mm", number),
            ("recalibrate", pyarrow.bool_()),
            ("parameters", pyarrow.list_(parameter)),
        ]
    )
    rows = [row for facts in cells for row in _rows(facts, parameters)]
    content = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema), content)
    write_atomically(path, content.getvalue())


def _rows(facts: CellFacts, parameters: Parameters) -> list[dict[str, object]]:
    """Return a row for every check of a cell, in the order in which they were made."""
    sessions = {one.name: one for one in facts.sessions}
    models = {one.name: one for one in facts.models}
    rows = []
    for check in facts.checks:
        session, model = sessions.get(check.session), models.get(check.model)
        new = model is not None and check.command in ("calibrate", "recalibrate")
        row = {
            "cell": Path(facts.folder).name,
            "day": session.day if session else model.day if model else "",
            "rows": session.rows if session else None,
            "temperature_c": session.temperature_c if session else None,
            "model_sha256": model.sha256 if model else "",
            "parameters": [asdict(one) for one in parameters.get(model.sha256, ())] if model and new else [],
        }
        rows.append(asdict(check) | row)
    return rows

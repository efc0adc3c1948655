"""The results of a fleet as one Parquet file, for DuckDB, pandas, Polars and whatever else asks a table."""

import io
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from pisigma.files.output_file import write_whole
from pisigma.lifetime.fleet.record import RobotRecord

RESULTS = "results.parquet"


def write_results(path: Path, records: Sequence[RobotRecord]) -> None:
    """Write one row per robot and session, ordered by both; parameters and warnings are lists in their columns.

    Raises:
        OutputError: it cannot be written; what was there stays.
        ImportError: pyarrow is not installed.
    """
    import pyarrow
    from pyarrow import parquet

    text, number = pyarrow.string(), pyarrow.float64()
    parameter = [
        ("name", text),
        ("unit", text),
        *((name, number) for name in ("value", "change", "standard_error")),
    ]
    schema = pyarrow.schema(
        [
            *((name, text) for name in ("robot", "session", "date", "file")),
            ("rows", pyarrow.int64()),
            *((name, text) for name in ("verdict", "sentence", "model")),
            *((name, number) for name in ("rms_mm", "held_out_rms_mm")),
            *((name, pyarrow.bool_()) for name in ("recalibrate", "moved")),
            ("parameters", pyarrow.list_(pyarrow.struct(parameter))),
            ("warnings", pyarrow.list_(text)),
        ]
    )
    rows = [
        {"robot": record.robot, **asdict(session)}
        for record in sorted(records, key=lambda one: one.robot)
        for session in record.sessions
    ]
    content = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema), content)
    write_whole(path, content.getvalue())

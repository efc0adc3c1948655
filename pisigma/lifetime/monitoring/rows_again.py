"""Rows of a session that the model was made of, or that were measured in another session: they count once."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pisigma.lifetime.monitoring.history import Record
from pisigma.measurement.copies import copies_of_known
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.training_rows import again_warnings


def new_rows(
    model: CalibratedModel,
    rows: Measurements,
    date: str,
    earlier: Sequence[Record],
    judged: Sequence[Record],
) -> tuple[Measurements, tuple[str, ...]]:
    """Leave out rows that the model was made of, and those of other sessions; says which.

    Args:
        model: the model.
        rows: of a session.
        date: of it.
        earlier: sessions of the history; one with exactly these rows is replaced, see `remember`.
        judged: sessions of this call.
    """
    sha256 = rows_hash(rows)
    warnings = [
        f"{Path(rows.source).name} of {date} has the rows of {one.file} of {one.date}, and takes its place."
        for one in earlier
        if one.rows_sha256 == sha256 and one.date != date
    ]
    others = [*(one for one in earlier if one.rows_sha256 != sha256), *judged]
    those = [(model.made_of, f"those that {model.name} was made of")]
    those += [(one.values, f"those of {one.file} of {one.date}") for one in others]
    for values, of in those:
        if values is not None and rows.rows:
            again = copies_of_known(rows.as_fields(), model.robot, values)
            warnings += again_warnings(rows, again, of)
            rows = rows.select(~again)
    return rows, tuple(warnings)


def rows_hash(rows: Measurements) -> str:
    """Hash of rows, whatever their date."""
    return replace(rows, date=None).content_hash()

"""Monitored sessions of a model: entries in the history, and selection of new rows."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter, ValidationError

from pisigma.files.errors import OutputError, Place
from pisigma.lifetime.cell.history import History, MonitoredSession
from pisigma.lifetime.monitoring.session import JointZeros, SessionResult
from pisigma.measurement.copies import RowValues, copies_of_known
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.training_rows import repeated_row_warnings

_SESSION = TypeAdapter(SessionResult)
_VALUES = {
    "numbers": "rows_numbers",
    "rounding_steps": "rows_steps",
    "step_index": "rows_kind",
    "file_index": "rows_file",
}
"""Key of every field of `RowValues` in a history."""
_ZEROS = {
    "shift": "shift",
    "sigma": "deviation",
    "model_sensitivity": "influence",
    "session_covariance": "own",
}
"""Key of every field of `JointZeros` in a history."""


@dataclass(frozen=True, eq=False)
class Record:
    """A session with its date.

    Attributes:
        file: file of the rows.
        date: date of the measurement (ISO 8601).
        rows_sha256: SHA-256 of the rows.
        temperature_c: mean temperature of the rows [°C]; None if they do not state it.
        session: result of the session.
        zeros: zeros of the joints.
        values: joint values and readings of the rows, for the recognition of repeated rows; None in histories of
            earlier versions.
    """

    file: str
    date: str
    rows_sha256: str
    temperature_c: float | None
    session: SessionResult
    zeros: JointZeros
    values: RowValues | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the session as plain values, lengths in mm."""
        session = self.session
        return {
            "file": self.file,
            "date": self.date,
            "rows": session.rows,
            "verdict": session.verdict,
            "unchanged_probability": session.unchanged_probability,
            "moved": [one.to_json() for one in session.movements],
            "candidates": [{"what": what, "probability": share} for what, share in session.candidates],
            "unobservable": [
                f"joint {k}" for k, seen in enumerate(session.zero_is_observable, 1) if not seen
            ],
            "remarks": list(session.unobservable_sentences),
            "outliers": list(session.outliers),
            "rms_mm": session.rms * 1e3,
            "expected_gain_mm": session.expected_gain * 1e3,
            "recalibrate": session.recalibrate,
        }


def store_sessions(history: History, model_sha256: str, records: Sequence[Record]) -> tuple[Record, ...]:
    """Store sessions in a history and return all sessions of the model.

    All sessions are stored in one transaction, or none if the process ends earlier. A session with the same rows as a
    stored session replaces it.

    Args:
        history: history of the model, or of its cell.
        model_sha256: hash of the model.
        records: sessions to store.

    Returns:
        All sessions of the model, sorted by date.

    Raises:
        OutputError: the file is not a history or cannot be written.
    """
    history.add(*(_entry(model_sha256, one) for one in records))
    return read_sessions(history, model_sha256)


def read_sessions(history: History, model_sha256: str) -> tuple[Record, ...]:
    """Read all sessions of a model, sorted by date; empty if there is no history yet.

    Raises:
        OutputError: the file is not a history, or a session cannot be read.
    """
    entries = [one for one in history.monitored_sessions() if one.model_sha256 == model_sha256]
    try:
        return sorted_sessions([_record(one) for one in entries])
    except (ValidationError, ValueError, KeyError) as problem:
        raise OutputError(
            f"a monitored session cannot be read: {problem}",
            at=Place(history.path),
            remedy="restore the file, or monitor without a history (--no-history)",
        ) from None


def _entry(model: str, record: Record) -> MonitoredSession:
    session = record.session
    return MonitoredSession(
        model_sha256=model,
        rows_sha256=record.rows_sha256,
        file=record.file,
        day=record.date,
        rows=session.rows,
        temperature_c=record.temperature_c,
        verdict=session.verdict,
        unchanged=session.unchanged_probability,
        rms_mm=session.rms * 1e3,
        rms_after_mm=session.rms_after_recalibration * 1e3,
        session=_SESSION.dump_json(session, by_alias=True).decode(),
        arrays=_packed(record.zeros, record.values),
    )


def _record(entry: MonitoredSession) -> Record:
    session, zeros = _SESSION.validate_json(entry.session), _unpacked(entry.arrays)
    return Record(entry.file, entry.day, entry.rows_sha256, entry.temperature_c, session, *zeros)


def sorted_sessions(records: Sequence[Record]) -> tuple[Record, ...]:
    """Sort sessions by date, and by file within a day."""
    return tuple(sorted(records, key=lambda one: (one.date, one.file, one.rows_sha256)))


def _packed(zeros: JointZeros, values: RowValues | None) -> bytes:
    stream = io.BytesIO()
    rows = {} if values is None else {key: getattr(values, field).numpy() for field, key in _VALUES.items()}
    np.savez(
        stream,
        **{key: getattr(zeros, field).numpy() for field, key in _ZEROS.items()},
        **rows,
    )
    return stream.getvalue()


def _unpacked(content: bytes) -> tuple[JointZeros, RowValues | None]:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        zeros = JointZeros(
            **{f: torch.from_numpy(arrays[key].astype(np.float64)) for f, key in _ZEROS.items()}
        )
        if not {*_VALUES.values()} <= set(arrays):
            return zeros, None
        return zeros, RowValues(*(torch.from_numpy(arrays[key]) for key in _VALUES.values()))


def new_rows(
    model: CalibratedModel,
    rows: Measurements,
    date: str,
    earlier: Sequence[Record],
    current_sessions: Sequence[Record],
) -> tuple[Measurements, tuple[str, ...]]:
    """Return the rows that neither belong to the calibration of the model nor to other sessions.

    Args:
        model: the model.
        rows: rows of a session.
        date: date of the session.
        earlier: sessions of the history; a session with exactly these rows is replaced, see `store_sessions`.
        current_sessions: sessions of this call.

    Returns:
        The new rows, and a warning for each set of rows that was left out.
    """
    sha256 = rows_hash(rows)
    warnings = [
        f"{Path(rows.source).name} of {date} has the same rows as {one.file} of {one.date}, and replaces it."
        for one in earlier
        if one.rows_sha256 == sha256 and one.date != date
    ]
    others = [*(one for one in earlier if one.rows_sha256 != sha256), *current_sessions]
    those = [(model.training_values, f"training rows of {model.name}")]
    those += [(one.values, f"rows of {one.file} of {one.date}") for one in others]
    for values, of in those:
        if values is not None and rows.rows:
            again = copies_of_known(rows.as_fields(), model.robot, values)
            warnings += repeated_row_warnings(rows, again, of)
            rows = rows.select(~again)
    return rows, tuple(warnings)


def rows_hash(rows: Measurements) -> str:
    """Compute the hash of rows without their dates."""
    return replace(rows, date=None).content_hash()

"""Recognise training rows of a model in later data, so that they are used only once."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.files.errors import MeasurementError, Place
from pisigma.measurement.copies import RowValues, copies_of_known, places_text
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import with_limits_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stored_starts import count_rows_at_starts
from pisigma.robot.description import Robot

_MAX_KEPT_ROWS = 10_000
"""Largest number of rows whose joint values and readings a model stores."""


def stored_training_rows(
    robot: Robot, rows: Measurements, earlier_values: RowValues | None = None
) -> RowValues:
    """Return the values of training rows that a model stores, following its earlier training rows `earlier_values`."""
    values = RowValues.from_rows(rows.as_fields(), robot)
    values = values if earlier_values is None else earlier_values + values
    count = len(values.numbers)
    return values.select(torch.linspace(0, count - 1, min(count, _MAX_KEPT_ROWS)).round().long())


def training_row_mask(model: CalibratedModel, rows: Measurements) -> Bool[Tensor, " rows"]:
    """Return the mask of the model's training rows, even if these are rounded, reordered or only some of them."""
    if model.training_values is None:
        whole = bool(model.provenance.data_sha256) and model.provenance.data_sha256 == rows.content_hash()
        return torch.full((rows.rows,), whole)
    return copies_of_known(rows.as_fields(), model.robot, model.training_values)


def without_known_rows(model: CalibratedModel, rows: Measurements) -> tuple[Measurements, tuple[str, ...]]:
    """Return the rows without training rows of the model, and warnings that list the latter.

    Raises:
        MeasurementError: all rows are training rows of the model.
    """
    known = training_row_mask(model, rows)
    if bool(known.all()):
        raise MeasurementError(
            f"expected new rows, got only rows whose joint values and readings equal those of training rows of model "
            f"'{model.name}'",
            expected="new rows",
            at=Place(rows.source),
            remedy="measure new rows",
        )
    return rows.select(~known), repeated_row_warnings(rows, known, f"training rows of {model.name}")


def repeated_row_warnings(
    rows: Measurements, is_known: Bool[Tensor, " rows"], model_name: str
) -> tuple[str, ...]:
    """Return a warning that names repeated rows, which are left out; empty if there are none."""
    count = int(is_known.sum())
    if not count:
        return ()
    verbs = "repeats {}, and counts" if count == 1 else "repeat {}, and count"
    places = places_text(rows.as_fields(), is_known)
    return (f"{count} of {rows.rows} rows {verbs.format(model_name)} only once: {places}.",)


def training_row_warnings(
    model: CalibratedModel,
    rows: Measurements,
    all_rows: Measurements | None = None,
    consequence: str = "its figures say nothing about other poses",
) -> tuple[str, ...]:
    """Return a warning if rows on which a model is evaluated are among its training rows; empty otherwise.

    A model stores joint values and readings of its rows. A model of an earlier version stores only a hash of all rows
    and the joint values of some rows, so poses that were measured again are also treated as training rows.

    Args:
        model: model of any kind.
        rows: rows on which the model is evaluated.
        all_rows: all rows of the file, if `rows` are only some of them.
        consequence: clause of the warning that states the consequence.
    """
    training_hash = model.provenance.data_sha256
    if training_hash and training_hash in (whole.content_hash() for whole in (rows, all_rows or rows)):
        return (f"{model.name} was calibrated with these rows, so {consequence}.",)
    known = training_row_mask(model, rows)
    if bool(known.any()):
        if bool(known.all()):
            return (f"{model.name} was calibrated with these rows, so {consequence}.",)
        return (
            f"{int(known.sum())} of {rows.rows} rows are training rows of {model.name} "
            f"({places_text(rows.as_fields(), known)}); for these, {consequence}.",
        )
    at_starts = count_rows_at_starts(model.starts.double().cpu(), rows.q.cpu())
    if not at_starts:
        return ()
    return (
        f"At least {at_starts} of {rows.rows} rows have joint values of training rows of {model.name} (it stores "
        f"{len(model.starts)} of {model.provenance.rows}); if they are the same measurements, {consequence}.",
    )


def with_wide_limits(model: CalibratedModel, rows: Measurements) -> CalibratedModel:
    """Return the model with its joint limits widened to include its training rows."""
    calibrated = None if model.calibrated is None else with_limits_of_rows(model.calibrated, rows)
    hybrid = model.hybrid
    if hybrid is not None:
        hybrid = replace(hybrid, robot=with_limits_of_rows(hybrid.robot, rows))
    robot = with_limits_of_rows(model.robot, rows)
    return replace(model, robot=robot, calibrated=calibrated, hybrid=hybrid)

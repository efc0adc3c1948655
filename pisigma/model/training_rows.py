"""Rows that a model was made of: they are recognised when they come again, and count once."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.measurement.copies import RowValues, copies_of_known, places_text
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.joint_range import with_limits_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stored_starts import rows_at_starts
from pisigma.robot.description import Robot

MOST_KEPT = 10_000
"""Rows of which a model keeps joint values and readings."""


def kept_rows(robot: Robot, rows: Measurements, before: RowValues | None = None) -> RowValues:
    """What a model keeps of the rows that it is made of, behind those that it was made of before."""
    values = RowValues.of(rows.as_fields(), robot)
    values = values if before is None else before + values
    count = len(values.numbers)
    return values.select(torch.linspace(0, count - 1, min(count, MOST_KEPT)).round().long())


def known_rows(model: CalibratedModel, rows: Measurements) -> Bool[Tensor, " rows"]:
    """Whether rows are measurements that a model was made of, perhaps rounded, in another order or in part."""
    if model.made_of is None:
        whole = bool(model.provenance.data_sha256) and model.provenance.data_sha256 == rows.content_hash()
        return torch.full((rows.rows,), whole)
    return copies_of_known(rows.as_fields(), model.robot, model.made_of)


def without_known_rows(model: CalibratedModel, rows: Measurements) -> tuple[Measurements, tuple[str, ...]]:
    """Leave out rows that a model was made of, which count already; says which.

    Raises:
        MeasurementError: there are no others.
    """
    known = known_rows(model, rows)
    if bool(known.all()):
        raise MeasurementError(
            f"{rows.source}: expected new rows, got those that {model.name} was made of, by joint values and readings; "
            "measure new ones."
        )
    return rows.select(~known), again_warnings(rows, known, f"those that {model.name} was made of")


def again_warnings(rows: Measurements, known: Bool[Tensor, " rows"], of: str) -> tuple[str, ...]:
    """Say which rows came again and do not count: a sentence, or nothing."""
    count = int(known.sum())
    if not count:
        return ()
    verb = "row is" if count == 1 else "rows are"
    places = places_text(rows.as_fields(), known)
    return (f"{count} of {rows.rows} {verb} {of} again, and count once: {places}.",)


def training_row_warnings(
    model: CalibratedModel,
    rows: Measurements,
    file: Measurements | None = None,
    consequence: str = "its figures say nothing about other poses",
) -> tuple[str, ...]:
    """Warn of rows that a model was made of: a sentence, or nothing.

    A model keeps joint values and readings of its rows; one of an earlier version the hash of all of them and the joint
    values of some. Poses that were measured again are said as well.

    Args:
        model: of any kind.
        rows: that it shall be judged by.
        file: all rows of their file, where these are a part of it.
        consequence: what follows.
    """
    made_of = model.provenance.data_sha256
    if made_of and made_of in (whole.content_hash() for whole in (rows, file or rows)):
        return (f"{model.name} was made of these rows, so {consequence}.",)
    known = known_rows(model, rows)
    if bool(known.any()):
        if bool(known.all()):
            return (f"{model.name} was made of these rows, so {consequence}.",)
        return (
            f"{int(known.sum())} of {rows.rows} rows are those that {model.name} was made of "
            f"({places_text(rows.as_fields(), known)}): as far as they count, {consequence}.",
        )
    at_starts = rows_at_starts(model.starts.double().cpu(), rows.q.cpu())
    if not at_starts:
        return ()
    return (
        f"At least {at_starts} of {rows.rows} rows have joint values that {model.name} was made with (it keeps "
        f"{len(model.starts)} of {model.provenance.rows}): as far as they are the same measurements, {consequence}.",
    )


def with_wide_limits(model: CalibratedModel, rows: Measurements) -> CalibratedModel:
    """Return the model with joint limits that are wide enough for the rows that it was made of."""
    calibrated = None if model.calibrated is None else with_limits_of_rows(model.calibrated, rows)
    hybrid = model.hybrid
    if hybrid is not None:
        hybrid = replace(hybrid, robot=with_limits_of_rows(hybrid.robot, rows))
    robot = with_limits_of_rows(model.robot, rows)
    return replace(model, robot=robot, calibrated=calibrated, hybrid=hybrid)

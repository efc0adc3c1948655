"""Rows that are no test of a model, as it was made of them or may have been."""

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stored_starts import rows_at_starts


def training_row_warnings(
    model: CalibratedModel,
    rows: Measurements,
    file: Measurements | None = None,
    consequence: str = "its figures say nothing about other poses",
) -> tuple[str, ...]:
    """Warn of rows that a model was made of: a sentence, or nothing.

    A model keeps the hash of all its rows and the joint values of some. A part of its rows, or the same among others,
    is known by these; so are poses that were measured again, which is said as well.

    Args:
        model: of any kind.
        rows: that it shall be judged by.
        file: all rows of their file, where these are a part of it.
        consequence: what follows.
    """
    made_of = model.provenance.data_sha256
    if made_of and made_of in (whole.content_hash() for whole in (rows, file or rows)):
        return (f"{model.name} was made of these rows, so {consequence}.",)
    known = rows_at_starts(model.starts.double().cpu(), rows.q.cpu())
    if not known:
        return ()
    return (
        f"At least {known} of {rows.rows} rows have joint values that {model.name} was made with (it keeps "
        f"{len(model.starts)} of {model.provenance.rows}): as far as they are the same measurements, {consequence}.",
    )

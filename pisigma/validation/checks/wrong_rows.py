"""Leave out single rows that no robot error explains, while all others agree with a model."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.robot_class import plausible_error_per_reach
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.checks.check import RowsUnderModel
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fit_frames
from pisigma.validation.held_out.frames.row_errors import errors_of_rows
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.explanations import plausible_orientation_error

FAR = 10.0
"""Ratio of an error to the median error above which a row is wrong, if the error is also larger than that of any
calibrated robot."""
_MAX_WRONG_SHARE = 0.1
"""Largest share of wrong rows; if more rows are far off, it is unknown which are wrong, and no row is left out."""
_MIN_ROWS, _MIN_ROWS_TO_FIT = 6, 10
"""Smallest numbers of rows with which a row can be called wrong, in known frames, and with frames or tools fitted to
the rows."""
_SUSPICIOUS, _REFITS = 3.0, 12
"""Ratio of an error to the median error above which a row is not used in the fit of frames and tools, and number of
such fits."""
MAX_NAMED = 5
"""Largest number of rows that a sentence lists."""


@dataclass(frozen=True, eq=False)
class FilteredRows:
    """Rows without wrong rows.

    Attributes:
        rows: the remaining rows; all rows if none is wrong.
        warnings: warnings about wrong rows and the sizes of their errors; empty if no row is wrong.
        wrong_row_indices: indices of the wrong rows, from 0.
    """

    rows: Measurements
    warnings: tuple[str, ...] = ()
    wrong_row_indices: tuple[int, ...] = ()


def without_wrong_rows(
    models: Iterable[CalibratedModel], rows: Measurements, fitted_kinds: Collection[FrameKind] = ()
) -> FilteredRows:
    """Leave out single rows that deviate too much from every model to have been measured correctly.

    Args:
        models: models with which the rows are compared.
        rows: the rows.
        fitted_kinds: frames and tools that are fitted to the rows.
    """
    found = [_far_rows(model, rows, fitted_kinds) for model in models]
    if not found or any(one is None for one in found):
        return FilteredRows(rows)
    numbers = sorted(set.intersection(*(set(one) for one in found if one is not None)))
    if not 0 < len(numbers) <= max(_MAX_WRONG_SHARE * rows.rows, 1):
        return FilteredRows(rows)
    kept = torch.ones(rows.rows, dtype=torch.bool)
    kept[numbers] = False
    sizes = found[0] or {}
    named = [f"{rows.place(number)} ({sizes[number]})" for number in numbers[:MAX_NAMED]]
    more = f" and {len(numbers) - MAX_NAMED} more" if len(numbers) > MAX_NAMED else ""
    have, are = (
        ("row has a larger error", "was") if len(numbers) == 1 else ("rows have larger errors", "were")
    )
    warning = (
        f"{len(numbers)} {have} than any calibrated robot, while the others agree with the model, and {are} left "
        f"out: {', '.join(named)}{more}; check these measurements, or measure the poses again."
    )
    return FilteredRows(rows.select(kept.nonzero()[:, 0]), (warning,), tuple(numbers))


def _far_rows(
    model: CalibratedModel, rows: Measurements, fitted_kinds: Collection[FrameKind]
) -> dict[int, str] | None:
    """Return the rows that are far off, with texts of their errors; None if the model cannot predict the rows."""
    if rows.position is None:
        return _far_lengths(model, rows)
    there = torch.isfinite(rows.position).all(-1)
    if int(there.sum()) < (_MIN_ROWS_TO_FIT if fitted_kinds else _MIN_ROWS):
        return None
    numbers = there.nonzero()[:, 0]
    judged = RowsUnderModel.from_rows(model, rows.select(numbers), fitted_kinds, ())
    if judged is None or judged.rows.rows != len(numbers):
        return None
    far, texts = _far(
        judged, _fitted_to_usual_rows(judged) if judged.fitted_kinds else judged.poses_before_fit
    )
    return {int(numbers[row]): texts[row] for row in far.nonzero()[:, 0].tolist()}


def _far_lengths(model: CalibratedModel, rows: Measurements) -> dict[int, str] | None:
    """Return the rows that are far off among rows without positions, such as balls in sockets; see `_far_rows`."""
    lengths = errors_of_rows(poses_of_rows(model, rows), rows).position.norm(dim=-1)
    there = torch.isfinite(lengths)
    if int(there.sum()) < _MIN_ROWS_TO_FIT:  # sockets and anchors are fitted to these rows
        return None
    far = lengths > max(
        FAR * float(lengths[there].median()), plausible_error_per_reach(model.robot) * model.robot.reach
    )
    return {row: length_text(float(lengths[row])) for row in far.nonzero()[:, 0].tolist()}


def _fitted_to_usual_rows(judged: RowsUnderModel) -> Float64[Tensor, "rows 4 4"]:
    """Return predicted poses, with frames and tools fitted to the rows that are not far off.

    Suspicious rows are replaced by their predictions before the next fit. The suspicious rows are selected again in
    every iteration, and the fits converge to that of the other rows.
    """
    T = judged.predicted
    for _ in range(_REFITS):
        lengths = judged.error_lengths(T)
        suspicious = lengths > _SUSPICIOUS * lengths.median()
        if bool(judged.measured.has_rotation.any()):
            angles = _angles(judged, T)
            suspicious = suspicious | (angles > _SUSPICIOUS * angles[judged.measured.has_rotation].median())
        if not bool(suspicious.any()):
            break
        usual = replace(
            judged.measured,
            position=torch.where(suspicious[:, None], T[:, :3, 3], judged.measured.position),
            rotation=torch.where(suspicious[:, None, None], T[:, :3, :3], judged.measured.rotation),
        )
        T = fit_frames(judged.poses_before_fit, usual, judged.rows, judged.fitted_kinds)[0]
    return T


def _angles(judged: RowsUnderModel, T: Float64[Tensor, "rows 4 4"]) -> Float64[Tensor, " rows"]:
    """Compute the angles between measured and predicted orientations [rad]; 0 in rows without an orientation."""
    angles = rotation_vector(judged.measured.rotation @ T[:, :3, :3].mT).norm(dim=-1)
    return torch.where(judged.measured.has_rotation, angles, 0.0)


def _far(judged: RowsUnderModel, T: Float64[Tensor, "rows 4 4"]) -> tuple[Bool[Tensor, " rows"], list[str]]:
    """Return the mask of the rows that are far off, and a text with the error of every row."""
    lengths = judged.error_lengths(T)
    robot = judged.model.robot
    far = lengths > max(FAR * float(lengths.median()), plausible_error_per_reach(robot) * robot.reach)
    texts = [length_text(length) for length in lengths.tolist()]
    turned = judged.measured.has_rotation
    if int(turned.sum()) >= _MIN_ROWS:
        angles = _angles(judged, T)
        typical = float(angles[turned].median())
        if typical <= plausible_orientation_error(
            robot
        ):  # otherwise the tool's orientation is unknown to the model
            far = far | (turned & (angles > max(FAR * typical, plausible_orientation_error(robot))))
            degrees = torch.rad2deg(angles).tolist()
            texts = [
                f"{text} and {degree:.3g} deg" if has else text
                for text, degree, has in zip(texts, degrees, turned.tolist(), strict=True)
            ]
    return far, texts

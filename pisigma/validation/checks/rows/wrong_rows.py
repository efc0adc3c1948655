"""Single rows that no robot's error explains, while all others agree with a model: they are named and left out."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.checks.rows.row_check import RowsUnderModel
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fit_frames
from pisigma.validation.held_out.frames.row_errors import errors_of_rows
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.explanations import PLAUSIBLE_SHARE, PLAUSIBLE_TURN

FAR = 10.0
"""Times the median error of the rows; wrong rows are farther off than that, and than any calibrated robot errs."""
MOST_WRONG = 0.1
"""Share of the rows; of more nobody knows which are wrong, and all are judged."""
FEWEST_ROWS, FEWEST_FITTED = 6, 10
"""Of fewer rows none is called wrong, and where frames or tools are fitted to them."""
SUSPICIOUS, REFITS = 3.0, 12
"""Times the median error of rows that frames and tools are not fitted to, and how often these are fitted."""
NAMED = 5
"""Rows that a sentence names, at most."""


@dataclass(frozen=True, eq=False)
class WithoutWrongRows:
    """Rows without those that are wrong.

    Attributes:
        rows: the others; all where none is wrong.
        warnings: which rows are wrong and by how much; nothing where none is.
        numbers: of the wrong rows.
    """

    rows: Measurements
    warnings: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()


def without_wrong_rows(
    models: Iterable[CalibratedModel], rows: Measurements, fitted: Collection[FrameKind] = ()
) -> WithoutWrongRows:
    """Leave out single rows that are too far off to be measured rightly, under every one of the models.

    Args:
        models: that the rows are judged by.
        rows: any.
        fitted: what is fitted to the rows.
    """
    found = [_far_rows(model, rows, fitted) for model in models]
    if not found or any(one is None for one in found):
        return WithoutWrongRows(rows)
    numbers = sorted(set.intersection(*(set(one) for one in found if one is not None)))
    if not 0 < len(numbers) <= max(MOST_WRONG * rows.rows, 1):
        return WithoutWrongRows(rows)
    kept = torch.ones(rows.rows, dtype=torch.bool)
    kept[numbers] = False
    sizes = found[0] or {}
    named = [f"{rows.place(number)} ({sizes[number]})" for number in numbers[:NAMED]]
    more = f" and {len(numbers) - NAMED} more" if len(numbers) > NAMED else ""
    verb = "row is" if len(numbers) == 1 else "rows are"
    warning = (
        f"{len(numbers)} {verb} farther off than any calibrated robot errs, while the others agree with the model, and "
        f"not judged: {', '.join(named)}{more}; check what was measured there, or measure the pose again."
    )
    return WithoutWrongRows(rows.select(kept.nonzero()[:, 0]), (warning,), tuple(numbers))


def _far_rows(
    model: CalibratedModel, rows: Measurements, fitted: Collection[FrameKind]
) -> dict[int, str] | None:
    """Number of every row that is far off, with how far; None where the rows cannot be judged by the model."""
    if rows.position is None:
        return _far_lengths(model, rows)
    there = torch.isfinite(rows.position).all(-1)
    if int(there.sum()) < (FEWEST_FITTED if fitted else FEWEST_ROWS):
        return None
    numbers = there.nonzero()[:, 0]
    judged = RowsUnderModel.of(model, rows.select(numbers), fitted, ())
    if judged is None or judged.rows.rows != len(numbers):
        return None
    far, texts = _far(judged, _fitted_to_usual_rows(judged) if judged.fitted else judged.drawn)
    return {int(numbers[row]): texts[row] for row in far.nonzero()[:, 0].tolist()}


def _far_lengths(model: CalibratedModel, rows: Measurements) -> dict[int, str] | None:
    """The same of rows without positions, such as balls in sockets."""
    lengths = errors_of_rows(poses_of_rows(model, rows), rows).position.norm(dim=-1)
    there = torch.isfinite(lengths)
    if int(there.sum()) < FEWEST_FITTED:  # sockets and anchors are fitted to them
        return None
    far = lengths > max(FAR * float(lengths[there].median()), PLAUSIBLE_SHARE * model.robot.reach)
    return {row: length_text(float(lengths[row])) for row in far.nonzero()[:, 0].tolist()}


def _fitted_to_usual_rows(judged: RowsUnderModel) -> Float64[Tensor, "rows 4 4"]:
    """Predict the poses with frames and tools fitted to the rows that are not far off.

    The poses of suspicious rows are taken to be as predicted and predicted again, which ends where the others alone
    would lead.
    """
    T = judged.predicted
    for _ in range(REFITS):
        lengths = judged.lengths(T)
        suspicious = lengths > SUSPICIOUS * lengths.median()
        if bool(judged.measured.has_rotation.any()):
            angles = _angles(judged, T)
            suspicious = suspicious | (angles > SUSPICIOUS * angles[judged.measured.has_rotation].median())
        usual = replace(
            judged.measured,
            position=torch.where(suspicious[:, None], T[:, :3, 3], judged.measured.position),
            rotation=torch.where(suspicious[:, None, None], T[:, :3, :3], judged.measured.rotation),
        )
        T = fit_frames(judged.drawn, usual, judged.rows, judged.fitted)[0]
    return T


def _angles(judged: RowsUnderModel, T: Float64[Tensor, "rows 4 4"]) -> Float64[Tensor, " rows"]:
    """Angles between measured and predicted orientations [rad]; 0 where none was measured."""
    angles = rotation_vector(judged.measured.rotation @ T[:, :3, :3].mT).norm(dim=-1)
    return torch.where(judged.measured.has_rotation, angles, 0.0)


def _far(judged: RowsUnderModel, T: Float64[Tensor, "rows 4 4"]) -> tuple[Bool[Tensor, " rows"], list[str]]:
    """Which rows are far off, and how far every row is."""
    lengths = judged.lengths(T)
    far = lengths > max(FAR * float(lengths.median()), PLAUSIBLE_SHARE * judged.model.robot.reach)
    texts = [length_text(length) for length in lengths.tolist()]
    turned = judged.measured.has_rotation
    if int(turned.sum()) >= FEWEST_ROWS:
        angles = _angles(judged, T)
        typical = float(angles[turned].median())
        if typical <= PLAUSIBLE_TURN:  # else the model knows nothing of the tool's orientation
            far = far | (turned & (angles > max(FAR * typical, PLAUSIBLE_TURN)))
            degrees = torch.rad2deg(angles).tolist()
            texts = [
                f"{text} and {degree:.3g} deg" if has else text
                for text, degree, has in zip(texts, degrees, turned.tolist(), strict=True)
            ]
    return far, texts

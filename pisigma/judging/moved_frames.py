"""Predictions in frames that were set up anew, such as those of a tracker that was moved since the calibration."""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import MeasurementError
from pisigma.judging.frame_fits import LEVER_SHARE, Seen, best_base
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.splits import k_folds
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import poses_of_rows

FITTED = (
    "Frames were fitted anew for every model, those of each row to other configurations: a wrong base of the robot is "
    "not seen."
)
"""What should be known of errors in such frames."""

FOLDS = 5
FEWEST = 12
"""Different joint vectors that a frame needs at least."""


def poses_in_fitted_frames(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """Where a model says that the targets were, every frame of the file fitted anew.

    The frame that a row is judged in is fitted to rows of other configurations, four fifths of them: a row has no part
    in it. Rigid, in closed form (see `best_base`).

    Args:
        model: of any kind; the frames that it knows do not matter.
        measurements: rows with positions.

    Raises:
        MeasurementError: a frame has too few different joint vectors, no positions were measured, or a target is
            unknown to the model.
    """
    if measurements.position is None:
        raise MeasurementError(
            f"{measurements.source}: no positions were measured, to which a frame could be fitted."
        )
    known = next(iter(model.bases), "")
    T = poses_of_rows(model, replace(measurements, frame=(known,) * measurements.rows)).clone()
    there = torch.isfinite(measurements.position).all(-1) & torch.isfinite(T).all(-1).all(-1)
    for name in dict.fromkeys(measurements.frame):
        rows = (there & torch.tensor([frame == name for frame in measurements.frame])).nonzero()[:, 0]
        part = measurements.select(rows)
        count = len(set(groups_to_keep_whole(part).tolist()))
        if count < FEWEST:
            what = f"frame '{name}'" if name else "the frame"
            raise MeasurementError(
                f"{measurements.source}: {what} holds {count} different joint vectors whose positions the model "
                f"'{model.name}' predicts, and fitting it takes {FEWEST} or more; measure more poses."
            )
        predicted, seen = T[rows], Seen.of(part, LEVER_SHARE * model.robot.reach)
        for others, judged in k_folds(part, FOLDS, seed=0):
            T[rows[judged]] = best_base(predicted[others], seen.select(others)) @ predicted[judged]
    return T

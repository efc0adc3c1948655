"""Rigid transforms before and behind predicted poses that explain measured ones best, in closed form."""

from dataclasses import dataclass, replace
from itertools import islice

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.errors import MeasurementError
from pisigma.identification.initial_guess.base_and_tool_closed_form import (
    nearest_rotation,
    starts_from_positions,
)
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.splits import k_folds
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import poses_of_rows
from pisigma.se3 import transform

LEVER_SHARE = 0.2
"""A rotation error counts like a position error at this share of the reach."""
ALTERNATIONS = 200
SETTLED = 1e-6
"""Alternating ends when a round lowers the cost by less than this share."""
FOLDS = 5
"""Folds that fitted frames are cross-validated with."""
FEWEST = 12
"""Different joint vectors that a frame needs at least."""
FRAMES_FITTED = (
    "The frames were fitted to these rows for every model, each row's frame to other configurations, so an error of "
    "the robot's base does not show."
)
"""What a user should know of errors in fitted frames."""


@dataclass(frozen=True, eq=False)
class MeasuredPoses:
    """Measured positions and rotations, ready for comparison with predicted poses.

    Attributes:
        position: measured positions [m].
        rotation: measured rotations; the identity where none was measured.
        has_rotation: which rows hold a rotation.
        lever: a rotation error counts like a position error at this distance [m].
    """

    position: Float64[Tensor, "rows 3"]
    rotation: Float64[Tensor, "rows 3 3"]
    has_rotation: Bool[Tensor, " rows"]
    lever: float

    @staticmethod
    def of(measurements: Measurements, lever: float) -> "MeasuredPoses":
        """Take the poses of measurements; every row has a position."""
        assert measurements.position is not None
        eye = torch.eye(3, dtype=torch.float64)
        if measurements.rotation is None:
            none = torch.zeros(measurements.rows, dtype=torch.bool)
            return MeasuredPoses(measurements.position, eye.expand(measurements.rows, 3, 3), none, lever)
        has_rotation = torch.isfinite(measurements.rotation).flatten(1).all(-1)
        rotation = torch.where(has_rotation[:, None, None], measurements.rotation, eye)
        return MeasuredPoses(measurements.position, rotation, has_rotation, lever)

    def select(self, rows: Tensor) -> "MeasuredPoses":
        """Select the rows of a mask or an index."""
        return MeasuredPoses(self.position[rows], self.rotation[rows], self.has_rotation[rows], self.lever)

    def scaled(self, factor: float) -> "MeasuredPoses":
        """Multiply the positions by a factor."""
        return replace(self, position=self.position * factor)

    @property
    def values(self) -> int:
        """Number of independent numbers that were measured."""
        return 3 * len(self.position) + 3 * int(self.has_rotation.sum())

    def squares(self, T: Float64[Tensor, "*batch rows 4 4"]) -> Float64[Tensor, "*batch rows"]:
        """Compute squared errors `|dp|² + lever² |dR|² / 2` [m²] of poses; |dR|²/2 is about the angle squared."""
        off = (self.position - T[..., :3, 3]).square().sum(-1)
        turn = (self.rotation - T[..., :3, :3]).square().sum((-2, -1)) / 2
        return off + self.lever**2 * torch.where(self.has_rotation, turn, 0.0)


def best_base(
    T: Float64[Tensor, "*batch rows 4 4"], measured: MeasuredPoses
) -> Float64[Tensor, "*batch 4 4"]:
    """Find the transform X for which `X T` are nearest to measured poses (weighted orthogonal Procrustes)."""
    middle, wanted = T[..., :3, 3].mean(-2, keepdim=True), measured.position.mean(0)
    M = (measured.position - wanted).mT @ (T[..., :3, 3] - middle)
    if bool(measured.has_rotation.any()):
        weight = measured.has_rotation.to(T)[:, None, None]
        M = M + measured.lever**2 / 2 * (weight * measured.rotation @ T[..., :3, :3].mT).sum(-3)
    R = nearest_rotation(M)
    return transform(R, wanted - (R @ middle.mT)[..., 0])


def best_tool(
    T: Float64[Tensor, "*batch rows 4 4"], measured: MeasuredPoses
) -> Float64[Tensor, "*batch 4 4"]:
    """Find the transform X for which `T X` are nearest to measured poses; it turns nothing without rotations."""
    R = T[..., :3, :3]
    offset = (R.mT @ (measured.position - T[..., :3, 3])[..., None])[..., 0].mean(-2)
    if not bool(measured.has_rotation.any()):
        return transform(torch.eye(3).to(T), offset)
    weight = measured.has_rotation.to(T)[:, None, None]
    return transform(nearest_rotation((weight * R.mT @ measured.rotation).sum(-3)), offset)


def best_base_and_tool(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, reach: float
) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]]:
    """Find transforms X, Y for which `X T Y` are nearest to measured poses, by alternating from two starts.

    Args:
        T: predicted poses.
        measured: what was measured there.
        reach: of the robot [m].
    """
    eye = torch.eye(4).to(T)
    starts = [eye]
    origin = torch.zeros(3, dtype=T.dtype)
    closed_forms = starts_from_positions(T[:, :3, :3], T[:, :3, 3], measured.position, origin, reach)
    starts += [transform(eye[:3, :3], offset) for _, _, offset in islice(closed_forms, 1)]
    return min((_alternated(T, measured, start) for start in starts), key=lambda ends: ends[0])[1:]


def _alternated(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, tool: Float64[Tensor, "4 4"]
) -> tuple[float, Tensor, Tensor]:
    """Alternate between base and tool; returns the cost, base and tool that it ends with."""
    cost, base = float("inf"), torch.eye(4).to(T)
    for _ in range(ALTERNATIONS):
        base = best_base(T @ tool, measured)
        tool = best_tool(base @ T, measured)
        before, cost = cost, float(measured.squares(base @ T @ tool).sum())
        if cost >= before * (1 - SETTLED):
            break
    return cost, base, tool


def poses_in_fitted_frames(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """Predict where the targets were, every frame of the file fitted anew, as after a tracker was moved.

    The frame that a row is judged in is fitted to rows of other configurations, four fifths of them: a row has no part
    in it. The fit is rigid and in closed form (see `best_base`).

    Args:
        model: of any kind; the frames that it holds do not matter.
        measurements: rows with positions.

    Raises:
        MeasurementError: a frame has too few different joint vectors, no positions were measured, or the model lacks
            a target.
    """
    if measurements.position is None:
        raise MeasurementError(
            f"{measurements.source}: no positions were measured, to which a frame could be fitted."
        )
    any_frame = next(iter(model.bases), "")
    T = poses_of_rows(model, replace(measurements, frame=(any_frame,) * measurements.rows)).clone()
    there = torch.isfinite(measurements.position).all(-1) & torch.isfinite(T).all(-1).all(-1)
    for name in dict.fromkeys(measurements.frame):
        rows = (there & torch.tensor([frame == name for frame in measurements.frame])).nonzero()[:, 0]
        of_frame = measurements.select(rows)
        count = len(set(groups_to_keep_whole(of_frame).tolist()))
        if count < FEWEST:
            what = f"frame '{name}'" if name else "the frame"
            raise MeasurementError(
                f"{measurements.source}: {what} holds {count} different joint vectors whose positions the model "
                f"'{model.name}' predicts, and fitting it takes {FEWEST} or more; measure more poses."
            )
        predicted, measured = T[rows], MeasuredPoses.of(of_frame, LEVER_SHARE * model.robot.reach)
        for others, judged in k_folds(of_frame, FOLDS, seed=0):
            T[rows[judged]] = best_base(predicted[others], measured.select(others)) @ predicted[judged]
    return T

"""Base of the robot in a frame whose axes were touched."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.robot.se3 import (
    nearest_rotation,
    rotation_from_rpy,
    rotation_from_vector,
    rpy_from_rotation,
    skew,
)

MIN_TOUCHES = 4
"""Touches along an axis needed to determine its direction."""
MIN_SPREAD_RATIO = 0.03
"""Smallest over largest spread of the tips needed to determine a direction."""
REFINEMENTS = 10
"""Gauss-Newton steps after the linear solution of a touched frame."""
MAX_RMS_SHARE = 0.05
"""Largest RMS residual of the touches with a guess, as a share of the reach."""
BASE_UNKNOWNS = 6


def fit_base_to_touches(
    tip: Float64[Tensor, "touches 3"],
    axis: Int64[Tensor, " touches"],
    touch: Float64[Tensor, " touches"],
    guess: Float64[Tensor, " 6"],
) -> tuple[Float64[Tensor, " 6"], float]:
    """Compute T_frame_robot from touches, with the tips in the robot's frame.

    `touch = R[axis] · tip + p[axis]` is linear in R and p for every axis separately; the third axis follows from two.
    Then all six unknowns are refined together. The refinement also starts at the guess, and the better result is used.

    Args:
        tip: nominal positions of the tip [m].
        axis: axis of the frame along which each touch was measured.
        touch: measured coordinates [m].
        guess: the robot's base, x, y, z [m], roll, pitch, yaw [rad].

    Returns:
        The base, and the RMS residual of the touches [m].
    """
    starts = [(rotation_from_rpy(guess[3:]), guess[:3])]
    linear = _linear_rotation(tip, axis, touch)
    if linear is not None:
        starts.insert(0, (linear, torch.zeros(3).to(tip)))
    best, miss = guess, float("inf")
    for R, p in starts:
        R, p, rms = _refined(tip, axis, touch, R, p)
        if rms < miss:
            best, miss = torch.cat([p, rpy_from_rotation(R)]), rms
    return best, miss


def _linear_rotation(tip: Tensor, axis: Tensor, touch: Tensor) -> Tensor | None:
    rows: list[Tensor | None] = []
    for k in range(3):
        points, values = tip[axis == k], touch[axis == k]
        rows.append(None)
        if len(points) < MIN_TOUCHES:
            continue
        centred = points - points.mean(0)
        singular = torch.linalg.svdvals(centred)
        if float(singular[-1]) > MIN_SPREAD_RATIO * float(singular[0]):
            row = torch.linalg.lstsq(centred, (values - values.mean())[:, None]).solution[:, 0]
            rows[k] = row / row.norm().clamp(min=1e-12)
    for k in range(3):
        following, last = rows[(k + 1) % 3], rows[(k + 2) % 3]
        if rows[k] is None and following is not None and last is not None:
            rows[k] = torch.linalg.cross(following, last)
    directions = [row for row in rows if row is not None]
    return nearest_rotation(torch.stack(directions)) if len(directions) == 3 else None


def _refined(tip: Tensor, axis: Tensor, touch: Tensor, R: Tensor, p: Tensor) -> tuple[Tensor, Tensor, float]:
    rows = torch.arange(len(tip))
    eye = torch.eye(3).to(tip)[axis]
    residual = touch - (tip @ R.mT + p)[rows, axis]
    for _ in range(REFINEMENTS):
        turned = tip @ R.mT
        J = torch.cat([eye, (-skew(turned))[rows, axis]], -1)
        step = torch.linalg.pinv(J, rtol=1e-6) @ residual
        R, p = rotation_from_vector(step[3:]) @ R, p + step[:3]
        residual = touch - (tip @ R.mT + p)[rows, axis]
    return R, p, float(residual.square().mean().sqrt())


def check_touched_base(measurements: Measurements, name: str, rms: float, reach: float) -> None:
    """Refuse a guess of a touched frame with large residuals.

    Raises:
        IdentificationError: the RMS residual of the touches is too large.
    """
    if rms <= MAX_RMS_SHARE * reach:
        return
    counts = ", ".join(f"{(measurements.touch_axis or ()).count(axis)} along {axis}" for axis in "xyz")
    raise IdentificationError(
        f"the touches of frame '{name}' ({counts}) do not determine its pose (the best fit has an RMS error of "
        f"{rms * 1e3:.3g} mm)",
        value=name,
        at=Place(measurements.source),
        remedy="check that all touches belong to this frame, or give the approximate base of the robot in it, "
        f"frames={{'{name}': (x, y, z, roll, pitch, yaw)}}",
    )


def check_touched_frames(measurements: Measurements, names: tuple[str, ...]) -> None:
    """Refuse frames with no more touches than the six unknowns of the frame.

    Raises:
        IdentificationError: a frame has six touches or fewer.
    """
    if measurements.touch is None:
        return
    touch = measurements.is_measured("touch").tolist()
    other = (measurements.is_measured("position") | measurements.is_measured("pose")).tolist()
    for name in names:
        rows = [row for row, frame in enumerate(measurements.frame) if frame == name]
        touches = sum(touch[row] for row in rows)
        if not touches or any(other[row] for row in rows) or touches > BASE_UNKNOWNS:
            continue
        raise IdentificationError(
            f"expected more than {BASE_UNKNOWNS} touches of frame '{name}', which has {BASE_UNKNOWNS} unknowns, got "
            f"{touches}",
            expected=f"more than {BASE_UNKNOWNS} touches of frame '{name}'",
            value=touches,
            at=Place(measurements.source),
            remedy=f"touch it about {3 * BASE_UNKNOWNS} times along x, y and z, or omit its rows",
        )

"""What every joint is corrected by over its own value, where that was measured, and how it fades beyond."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.kinematics.forward import forward_kinematics
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot

POINTS = 1_500
"""Of a curve: 13 to a period of the 110th harmonic over a whole turn."""
CHUNK = 4_096


@dataclass(frozen=True, eq=False)
class CorrectionCurve:
    """The correction of one joint.

    Attributes:
        joint: its name.
        unit: of its values, "deg" or "mm".
        small_unit: of its correction, "mdeg" or "µm".
        values: over the joint's range.
        correction: in force there.
        measured: whether the joint value was measured.
        dots: corrections at measured rows.
        dot_values: joint values there.
        sentence: what is seen.
    """

    joint: str
    unit: str
    small_unit: str
    values: Float64[np.ndarray, " points"]
    correction: Float64[np.ndarray, " points"]
    measured: Bool[np.ndarray, " points"]
    dots: Float64[np.ndarray, " dots"]
    dot_values: Float64[np.ndarray, " dots"]
    sentence: str


def correction_curves(model: CalibratedModel) -> tuple[CorrectionCurve, ...]:
    """Curves of all joints that are corrected, the others as in the training row nearest to the middle of all.

    Returns:
        Nothing for a model without a learned correction.
    """
    if (model.hybrid is None and model.network is None) or not len(model.starts):
        return ()
    robot, q = model.robot, model.starts
    seen = correction_at(model, q)
    middle = _middle_row(q)
    found = []
    for j in range(robot.dof):
        own = torch.linspace(*_range(robot, q, j), POINTS, dtype=torch.float64)
        at = middle.repeat(POINTS, 1)
        at[:, j] = own
        share = _share(model, at, j)
        curve = correction_at(model, at)[:, j] * share
        if bool((curve != 0).any()) or bool((seen[:, j] != 0).any()):
            found.append(_curve(robot, j, own, curve, share, (q[:, j], seen[:, j])))
    return tuple(found)


def correction_at(model: CalibratedModel, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "rows dof"]:
    """The learned correction in full, at joint values [rad or m]."""
    parts = []
    with torch.no_grad():
        for part in torch.split(q, CHUNK):
            if model.hybrid is not None:
                parts.append(model.hybrid.correction(part))
            else:
                parts.append(model.correction(forward_kinematics(model.robot, part), part))
    return torch.cat(parts)


def _share(
    model: CalibratedModel, q: Float64[Tensor, "points dof"], joint: int
) -> Float64[Tensor, " points"]:
    """How much of the correction is in force as one joint leaves its measured values."""
    if model.hybrid is not None:
        from pisigma.hybrid.coverage import share_beyond

        coverage = model.hybrid.coverage
        return share_beyond(coverage.beyond(q)[:, joint], coverage.fade)
    return torch.ones(len(q), dtype=torch.float64)


def _middle_row(q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, " dof"]:
    spread = (q.amax(0) - q.amin(0)).clamp(min=1e-9)
    off = ((q - q.median(0).values) / spread).square().sum(-1)
    return q[int(off.argmin())]


def _range(robot: Robot, q: Float64[Tensor, "rows dof"], joint: int) -> tuple[float, float]:
    """The joint's measured values and a fifth more on either side, within its limits."""
    low, high = float(q[:, joint].min()), float(q[:, joint].max())
    more = max((high - low) / 5, math.radians(20) if robot.revolute[joint] else 0.02)
    lower, upper = robot.limits[joint]
    return max(low - more, float(lower)), min(high + more, float(upper))


def _curve(
    robot: Robot, j: int, own: Tensor, curve: Tensor, share: Tensor, dots: tuple[Tensor, Tensor]
) -> CorrectionCurve:
    name, turns = robot.joints[j].name, robot.revolute[j]
    factor, small = (math.degrees(1.0), math.degrees(1e3)) if turns else (1e3, 1e6)
    unit, small_unit = ("deg", "mdeg") if turns else ("mm", "µm")
    value, at = dots[1].numpy() * small, dots[0].numpy() * factor
    inside = share.numpy() == 1
    size = float(np.sqrt((value**2).mean()))
    sentence = (
        f"RMS {size:.3g} {small_unit}, at most {np.abs(value).max():.3g}, at the rows that the model keeps"
    )
    low, high = own.numpy()[inside].min(initial=math.inf), own.numpy()[inside].max(initial=-math.inf)
    if not inside.all() and high > low:
        sentence += f"; measured from {low * factor:.0f} to {high * factor:.0f} {unit}, beyond it fades"
    return CorrectionCurve(
        name, unit, small_unit, own.numpy() * factor, curve.numpy() * small, inside, value, at, f"{sentence}."
    )

"""What a calibration changed: geometric parameters with their doubts, and the correction of every joint."""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.model_files import CORRELATION_CSV, read_model_file
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_figures import JOINT_UNITS
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.tolerances import MEASURED_ROUNDING
from pisigma.validation.held_out.calibration_summary import CalibrationSummary

POINTS = 1_500
"""Of a curve: 13 to a period of the 110th harmonic over a whole turn."""
CHUNK = 4_096
STRONG = 0.9
"""Pairs of parameters with a larger correlation are named."""
MOST_PAIRS = 12
Correlations = tuple[tuple[str, ...], Float64[np.ndarray, "_names _names"]]
"""Names of parameters, and the table of their correlations."""


@dataclass(frozen=True, eq=False)
class ParameterFindings:
    """What is said of parameters.

    Attributes:
        pairs: strongly correlated parameters and their correlation, strongest first.
        correlations: names and table of lengths and of angles; empty where they are not kept.
        missing: what the folder does not keep, in sentences.
    """

    pairs: tuple[tuple[str, str, float], ...]
    correlations: tuple[Correlations, ...]
    missing: tuple[str, ...]


def parameter_findings(
    model: CalibratedModel, summary: CalibrationSummary | None, folder: Path
) -> ParameterFindings:
    """Gather it from the figures of a calibration, if there are some, and the files of the model's folder."""
    tables = read_correlations(folder / CORRELATION_CSV)
    if summary is not None:
        text = "The model folder does not keep the correlations as numbers; calibrate again to have them."
        missing = () if tables else (text,)
    elif model.calibrated is None:
        missing = ("This model has no identified parameters: its geometry is the nominal one.",)
    else:
        missing = ("The model folder does not keep the figures of its parameters; calibrate again.",)
    return ParameterFindings(_pairs(tables), tables, missing)


def read_correlations(path: Path) -> tuple[Correlations, ...]:
    """Read the tables of lengths and of angles; nothing where there is no such file, or it holds something else."""
    if not path.is_file():
        return ()
    kinds: dict[str, dict[tuple[str, str], float]] = {"lengths": {}, "angles": {}}
    tables = []
    try:
        text = read_model_file(path.parent, path.name).decode()
        for row in csv.DictReader(io.StringIO(text, newline="")):
            value = float(row["correlation"]) if row["correlation"] else np.nan
            kinds[row["of"]][row["parameter"], row["with"]] = value
        for cells in kinds.values():
            names = tuple(dict.fromkeys(name for name, _ in cells))
            values = np.array([[cells[a, b] for b in names] for a in names])
            tables.append((names, values.reshape(len(names), -1)))
    except (KeyError, ValueError, TypeError, OSError):
        return ()
    return tuple(tables)


def _pairs(tables: tuple[Correlations, ...]) -> tuple[tuple[str, str, float], ...]:
    """List strongly correlated parameters, the strongest first."""
    strong = [
        (name, names[k], float(values[i, k]))
        for names, values in tables
        for i, name in enumerate(names)
        for k in range(i)
        if abs(values[i, k]) >= STRONG
    ]
    return tuple(sorted(strong, key=lambda pair: -abs(pair[2]))[:MOST_PAIRS])


@dataclass(frozen=True, eq=False)
class CorrectionCurve:
    """The correction of one joint.

    Attributes:
        joint: its name.
        unit: of its values, "deg" or "mm".
        small_unit: of its correction, "mdeg" or "µm".
        values: over the joint's range.
        correction: there.
        measured: whether the joint value was measured.
        dots: corrections at measured rows.
        dot_values: joint values there.
        sentence: how large it is, and where it was measured.
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
    """Compute curves of all corrected joints, the others as in the training row nearest to the middle of all.

    Returns:
        Nothing for a model without a learned correction.
    """
    robot, hybrid, q = model.robot, model.hybrid, model.starts
    if (hybrid is None and model.network is None) or not len(q):
        return ()
    at_rows, middle = correction_at(model, q), _middle_row(q)
    curves = []
    for j in range(robot.dof):
        at = middle.repeat(POINTS, 1)
        at[:, j] = torch.linspace(*_range(robot, q, j), POINTS, dtype=torch.float64)
        measured = torch.ones(POINTS, dtype=torch.bool)
        if hybrid is not None:
            measured = hybrid.coverage.beyond(at)[:, j] <= MEASURED_ROUNDING
        curve = correction_at(model, at)[:, j]
        if bool((curve != 0).any()) or bool((at_rows[:, j] != 0).any()):
            curves.append(_curve(robot, j, at[:, j], curve, measured, q[:, j], at_rows[:, j]))
    return tuple(curves)


def correction_at(model: CalibratedModel, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "rows dof"]:
    """Compute the learned correction at joint values [rad or m]."""
    hybrid, chunks = model.hybrid, torch.split(q, CHUNK)
    with torch.no_grad():
        if hybrid is not None:
            return torch.cat([hybrid.correction(chunk) for chunk in chunks])
        return torch.cat(
            [model.correction(forward_kinematics(model.robot, chunk), chunk) for chunk in chunks]
        )


def _middle_row(q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, " dof"]:
    spread = (q.amax(0) - q.amin(0)).clamp(min=1e-9)
    off = ((q - q.median(0).values) / spread).square().sum(-1)
    return q[int(off.argmin())]


def _range(robot: Robot, q: Float64[Tensor, "rows dof"], joint: int) -> tuple[float, float]:
    """Give the joint's measured values and a fifth more on either side, within its limits."""
    low, high = float(q[:, joint].min()), float(q[:, joint].max())
    more = max((high - low) / 5, math.radians(20) if robot.revolute[joint] else 0.02)
    lower, upper = robot.limits[joint]
    return max(low - more, float(lower)), min(high + more, float(upper))


def _curve(
    robot: Robot, joint: int, q: Tensor, curve: Tensor, measured: Tensor, q_rows: Tensor, at_rows: Tensor
) -> CorrectionCurve:
    """Convert a curve over joint values, and corrections at measured rows, to units for people."""
    unit, factor, small_unit, small = JOINT_UNITS[robot.joints[joint].type]
    values, dots, inside = q.numpy() * factor, at_rows.numpy() * small, measured.numpy()
    rms = float(np.sqrt((dots**2).mean()))
    sentence = (
        f"RMS {rms:.3g} {small_unit}, at most {np.abs(dots).max():.3g}, at the rows that the model keeps"
    )
    low, high = values[inside].min(initial=math.inf), values[inside].max(initial=-math.inf)
    if not inside.all() and high > low:
        sentence += f"; measured from {low:.0f} to {high:.0f} {unit}, extrapolated beyond"
    return CorrectionCurve(
        joint=robot.joints[joint].name,
        unit=unit,
        small_unit=small_unit,
        values=values,
        correction=curve.numpy() * small,
        measured=inside,
        dots=dots,
        dot_values=q_rows.numpy() * factor,
        sentence=f"{sentence}.",
    )

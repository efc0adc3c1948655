"""Check for unstated backlash: whether the residuals depend on the direction from which every joint arrived."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.errors import IdentificationError
from pisigma.measurement.conditions import approach_by_order
from pisigma.measurement.dataset import Measurements
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.validation.checks.lag import LIKELY, MIN_ROWS, NOTICED, find_lag
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import join_words, joints_text, length_text
from pisigma.validation.setup_faults.ordered_rows import OrderedRows


@dataclass(frozen=True)
class LostMotion:
    """Backlash of joints whose last motions are known from the order of the rows.

    Attributes:
        joint_backlash: backlash of the joints by their index [rad or m].
        error_increase_factor: ratio of the errors of the rows without and with the backlash in the model [1].
        log_bayes_factor: logarithm of the odds of backlash in these joints against none.
    """

    joint_backlash: dict[int, float]
    error_increase_factor: float
    log_bayes_factor: float


def find_backlash(rows: OrderedRows, measurements: Measurements) -> LostMotion | None:
    """Fit half the backlash of every joint to the residuals of a calibration: `r = X x + Σ_j J_j s_j b_j + e`.

    `s_j` is the sign of the joint's last motion. With friction the joint lags behind (b_j < 0); without it, inertia
    carries the joint through the play when the drive stops. Joints are added one by one as long as the odds increase,
    with a penalty for each additional parameter (`OrderedRows.evidence_of`) and for the choice of the joint.

    Args:
        rows: residuals of a calibration.
        measurements: the rows of the calibration, with the directions of the last motions.

    Returns:
        None if there are too few rows or no joint can be tested.
    """
    if len(rows.residual) < MIN_ROWS:
        return None
    assert measurements.approach is not None
    rows = rows.with_estimated_noise
    approach = measurements.approach.nan_to_num(0.0).cpu().numpy()[rows.row_index]
    moved = (rows.joint_derivative * approach[:, None]).reshape(-1, approach.shape[1])
    free = rows.project_out_parameters(moved)
    possible = np.flatnonzero((free**2).sum(0) > 1e-12 * (moved**2).sum(0)).tolist()
    best = None
    for count in range(1, len(possible) + 1):
        earlier = () if best is None else tuple(best.joint_backlash)
        found = []
        for joint in possible:
            if joint in earlier:
                continue
            joints = (*earlier, joint)
            effect = rows.evidence_of(free[:, joints])
            play = dict(zip(joints, (2 * np.abs(effect.effect_sizes)).tolist(), strict=True))
            choice = math.log(math.comb(len(possible), count))
            found.append(LostMotion(play, effect.error_increase_factor, effect.log_bayes_factor - choice))
        better = max(found, key=lambda one: one.log_bayes_factor, default=None)
        if better is None or (best is not None and better.log_bayes_factor <= best.log_bayes_factor):
            break
        best = better
    return best


def with_approach_by_order(
    calibrator: GeometricCalibrator,
    rows: Measurements,
    select_rows: Callable[[Measurements], Measurements] = lambda rows: rows,
    result: CalibrationResult | None = None,
) -> tuple[Measurements, tuple[Diagnostic, ...]]:
    """State the directions of the last motions in rows without directions of approach, if these matter.

    Args:
        calibrator: a geometric calibrator of the robot.
        rows: all rows of the files, because the last motion follows from the preceding row.
        select_rows: function that selects the rows that decide whether the directions matter.
        result: calibration with the selected rows; None to calibrate.

    Returns:
        The rows, and the finding of `unstated_backlash`; without a finding, the unchanged rows and None.
    """
    if rows.approach is not None:
        return rows, ()
    sided = replace(rows, approach=approach_by_order(rows))
    found = unstated_backlash(calibrator, select_rows(sided), result)
    return (rows, ()) if found is None else (sided, (found,))


def unstated_backlash(
    calibrator: GeometricCalibrator, rows: Measurements, result: CalibrationResult | None = None
) -> Diagnostic | None:
    """Test whether the directions of the last motions matter in rows that state no directions of approach.

    A lag between joint values and measurements also depends on the last motion; the explanation with the larger
    evidence is assumed.

    Args:
        calibrator: a geometric calibrator of the robot.
        rows: the rows, with the directions that follow from their order (`approach_by_order`).
        result: calibration with the rows without directions; None to calibrate.

    Returns:
        A warning that names the joints and their backlash; None if there is none.
    """
    if rows.position is None:
        return None
    try:
        result = calibrator.fit(replace(rows, approach=None)) if result is None else result
    except IdentificationError:
        return None  # the calibration itself rejects these rows
    ordered = OrderedRows.from_result(result)
    found = None if ordered is None else find_backlash(ordered, rows)
    if (
        ordered is None
        or found is None
        or found.log_bayes_factor < LIKELY
        or found.error_increase_factor < NOTICED
    ):
        return None
    lag = find_lag(ordered, rows)
    if lag is not None and lag.log_bayes_factor > found.log_bayes_factor:
        return None
    return _diagnostic(result, rows, found)


def _diagnostic(result: CalibrationResult, rows: Measurements, found: LostMotion) -> Diagnostic:
    """Name the joints with backlash, its size, and what it means for commanded poses of the fitted tools."""
    robot = result.robot
    joints = tuple(sorted(found.joint_backlash))
    play = [found.joint_backlash[joint] for joint in joints]
    per_unit = [(180 / math.pi, "deg") if robot.revolute[joint] else (1e3, "mm") for joint in joints]
    sizes = [(size * factor, unit) for size, (factor, unit) in zip(play, per_unit, strict=True)]
    tools = [robot.with_geometry(tool=tool) for tool in result.tools.values()]
    J = torch.cat([joint_jacobian(tool, rows.q)[1][:, :3, list(joints)] for tool in tools])
    error = float((J * J.new_tensor(play) / 2).square().sum((1, 2)).mean().sqrt())
    remedy = (
        "State the side from which each joint approaches (docs/how-to/backlash.md), in the rows and for the poses "
        "to command."
    )
    return Diagnostic(
        kind="backlash",
        severity="warning",
        sentence=f"{joints_text(joints).capitalize()}: a backlash of about "
        f"{join_words(f'{size:.2g} {unit}' for size, unit in sizes)}. The errors depend on the direction of "
        f"the last motion and are {found.error_increase_factor:.3g} times as large as without this effect. The "
        "directions were taken from the order of the rows, and errors of held-out rows are errors with known "
        f"directions; without them, commanded poses have further errors of {length_text(error)} RMS. {remedy}",
        cause="unstated",
        values={
            "joints": tuple(joint + 1 for joint in joints),
            "factor": found.error_increase_factor,
            "log_odds": found.log_bayes_factor,
            "error_mm": error * 1e3,
        }
        | {f"play{joint + 1}_{unit}": size for joint, (size, unit) in zip(joints, sizes, strict=True)},
        remedy=remedy,
    )

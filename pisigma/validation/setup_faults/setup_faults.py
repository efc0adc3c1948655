"""Search for common setup faults that explain large errors of a model, by trying each of them on the data."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import torch

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses
from pisigma.robot.robot_class import plausible_error_per_reach
from pisigma.validation.held_out.calibration_summary import has_orientation
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fit_frames, with_known_names
from pisigma.validation.held_out.model_comparison import ModelFigures
from pisigma.validation.setup_faults.explanations import (
    choose_simplest,
    fault_hypotheses,
    frame_hypotheses,
    max_explained_error,
    plausible_orientation_error,
)
from pisigma.validation.setup_faults.hypothesis import Hypothesis, PredictingArm
from pisigma.validation.setup_faults.joint_faults import NOTICED
from pisigma.validation.setup_faults.nominal_robot_faults import (
    MAX_ROWS,
    evenly_spaced_rows,
    find_nominal_robot_faults,
    rows_with_position,
)
from pisigma.validation.setup_faults.setup_fault import SetupFault, fault_from_hypothesis

_CAUSES = {"base": "frame", "tool": "tool"}
"""Kind of the cause of a motion by the kind of frame."""


@torch.no_grad()
def find_setup_faults(
    model: CalibratedModel,
    nominal: CalibratedModel | None,
    measurements: Measurements,
    fitted_kinds: Collection[FrameKind] = (),
    frames_only: bool = False,
) -> tuple[SetupFault, ...]:
    """Find setup faults that reduce the errors of a model to a quarter or less, simplest first.

    The hypotheses are: another frame and another tool (best-fitting rigid transforms), positions in other units or
    mirrored, orientations in another convention, shifted rows, degrees for radians or millimetres for metres (and vice
    versa) in joint columns, all orders and signs of the joints, pairs of coupled joints, zeros moved by multiples of 90
    deg or one zero moved by any amount, and a correction that was applied once more or once less than logged; each is
    also tried together with another frame and tool, as after a new setup of the sensor. Several faults are returned if
    they explain the errors equally well. If nothing explains the errors, the nominal robot is tried; see
    `find_nominal_robot_faults`.

    Args:
        model: the model.
        nominal: the nominal robot with base and tool fitted, to report its errors after the correction; None to omit
            them.
        measurements: rows with positions in frames and of targets of the model; joint limits are not considered.
        fitted_kinds: frames or targets that are fitted to the rows; any name is allowed, and a motion is not a fault.
        frames_only: whether to try only motions of frames and tools.

    Returns:
        The faults; empty if the errors are below 0.02 mm, or if nothing explains them.
    """
    judged = without_unknown_orientation(model, measurements)
    some = judged.select(evenly_spaced_rows(rows_with_position(judged), MAX_ROWS))
    known = with_known_names(model, some, fitted_kinds)
    T = poses_of_rows(model, known)
    predicted = torch.isfinite(T).flatten(1).all(-1)
    if not bool(predicted.any()):
        return ()
    some, known, T = some.select(predicted), known.select(predicted), T[predicted]
    measured = MeasuredPoses.from_tensors(some.position, some.rotation, LEVER_SHARE * model.robot.reach)
    here = Hypothesis(some.q, T, measured)
    if fitted_kinds:
        T, columns = fit_frames(T, measured, some, fitted_kinds)
        here = replace(here, T=T, fitted_parameters=columns.shape[-1])
    if not here.error > NOTICED:
        return ()
    arm = PredictingArm(model.robot, model)
    most = max_explained_error(here, model.robot)
    tried = (
        frame_hypotheses(arm, known, [here], most)
        if frames_only
        else fault_hypotheses(arm, known, here, most)
    )
    free = {_CAUSES[kind] for kind in fitted_kinds}
    faults = tuple(
        fault_from_hypothesis(here, other.without_causes(free), _nominal_error(nominal, known, other))
        for other in choose_simplest(list(tried), most)
        if not {cause.kind for cause in other.causes} <= free
    )
    if not faults and not frames_only:
        faults = find_nominal_robot_faults(model.robot, with_known_names(model, judged, fitted_kinds))
    return faults


def _nominal_error(nominal: CalibratedModel | None, some: Measurements, other: Hypothesis) -> float:
    """Compute the RMS position error [m] of the nominal robot under a hypothesis."""
    kinds = {cause.kind for cause in other.causes}
    if nominal is None or "correction" in kinds:
        return float("nan")
    T = poses_of_rows(nominal, replace(some, q=other.q))
    tried = frame_hypotheses(
        PredictingArm(nominal.robot, nominal), some, [Hypothesis(other.q, T, other.measured)]
    )
    wanted = kinds & {"frame", "tool"}
    return next(one.rms()[0] for one in tried if {cause.kind for cause in one.causes} == wanted)


def without_unknown_orientation(model: CalibratedModel, measurements: Measurements) -> Measurements:
    """Return the rows without orientations if the orientation of the tool is unknown to the model."""
    if has_orientation(model):
        return measurements
    return replace(measurements, rotation=None, sigma_rotation=None)


def is_implausible(figures: ModelFigures, model: CalibratedModel) -> bool:
    """Return whether errors of positions or of orientations are too large for a calibrated robot.

    Args:
        figures: figures of the model, or of another model with its base and tool.
        model: the model.
    """
    orientation = figures.orientation if has_orientation(model) else None
    limit = plausible_error_per_reach(model.robot) * model.robot.reach
    turn = 0.0 if orientation is None else np.deg2rad(orientation.statistics["rms"])
    return figures.position.statistics["rms"] * 1e-3 > limit > 0 or turn > plausible_orientation_error(
        model.robot
    )


def unexplained_diagnostic(model: CalibratedModel) -> Diagnostic:
    """Return the finding that no setup fault explains implausible errors of a model, with advice on what to check."""
    robot = model.robot
    limit, turn = (
        plausible_error_per_reach(robot) * robot.reach * 1e3,
        np.rad2deg(plausible_orientation_error(robot)),
    )
    return Diagnostic(
        kind="implausible_errors",
        severity="implausible",
        sentence=f"Errors of more than {limit:.3g} mm or {turn:.2g} deg are not geometric errors of the robot, but no "
        "usual setup fault (frame, tool, units, conventions of orientations, shifted rows, order, signs and zeros of "
        "the joints, correction applied twice or not at all) explains them; check whether this robot was measured, and "
        "whether the joint values and measurements of each row belong together.",
    )

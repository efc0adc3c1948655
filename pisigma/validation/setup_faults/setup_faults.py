"""The usual setup faults behind large errors of a model, recognised by trying each on the data."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import torch

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses
from pisigma.validation.held_out.calibration_summary import has_orientation
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fit_frames, with_names_of
from pisigma.validation.held_out.model_comparison import ModelFigures
from pisigma.validation.setup_faults.explanations import (
    PLAUSIBLE_SHARE,
    PLAUSIBLE_TURN,
    hypotheses,
    in_frames,
    largest_explained,
    simplest,
)
from pisigma.validation.setup_faults.faults_as_drawn import (
    MOST_ROWS,
    find_faults_as_drawn,
    measured_rows,
    spread,
)
from pisigma.validation.setup_faults.hypothesis import Hypothesis, PredictingArm
from pisigma.validation.setup_faults.joint_faults import NOTICED
from pisigma.validation.setup_faults.setup_fault import SetupFault, fault_of

CAUSES = {"base": "frame", "tool": "tool"}
"""Kind of the cause that a base or a tool has moved."""


@torch.no_grad()
def find_setup_faults(
    model: CalibratedModel,
    nominal: CalibratedModel | None,
    measurements: Measurements,
    fitted: Collection[FrameKind] = (),
    frames_only: bool = False,
) -> tuple[SetupFault, ...]:
    """Find what makes the errors of a model collapse to a quarter or less, the simplest first.

    Tried are: another frame and another tool (rigid transforms that fit best), positions in other units or mirrored,
    orientations in another convention, rows shifted against each other, degrees for radians, millimetres for metres and
    the reverse in joint columns, all orders and all signs of the joints, pairs of coupled joints, zeros moved by
    quarter turns or one zero moved by anything, and a correction that was applied once more or once less than logged;
    each also together with another frame and tool, which a new set-up of the sensor has. Several are returned where
    they explain equally well. Where nothing explains the errors, the robot as drawn is tried: see
    `find_faults_as_drawn`.

    Args:
        model: the model.
        nominal: the nominal robot with the base and tool that suit it best; only shows what its errors fall to.
            None not to show that.
        measurements: rows with positions in frames and of targets that the model has; limits do not matter.
        fitted: whether frames or targets are fitted anew: then any will do, and that one has moved is no fault.
        frames_only: try only that frames or tools have moved.

    Returns:
        Nothing where errors are below 0.02 mm, or where nothing explains them.
    """
    judged = judged_values(model, measurements)
    some = judged.select(spread(measured_rows(judged), MOST_ROWS))
    known = with_names_of(model, some, fitted)
    T = poses_of_rows(model, known)
    predicted = torch.isfinite(T).flatten(1).all(-1)
    if not bool(predicted.any()):
        return ()
    some, known, T = some.select(predicted), known.select(predicted), T[predicted]
    measured = MeasuredPoses.of(some.position, some.rotation, LEVER_SHARE * model.robot.reach)
    here = Hypothesis(some.q, T, measured)
    if fitted:
        T, columns = fit_frames(T, measured, some, fitted)
        here = replace(here, T=T, fitted=columns.shape[-1])
    if not here.error > NOTICED:
        return ()
    arm = PredictingArm(model.robot, model)
    most = largest_explained(here, model.robot.reach)
    tried = in_frames(arm, known, here, most) if frames_only else hypotheses(arm, known, here, most)
    free = {CAUSES[kind] for kind in fitted}
    faults = tuple(
        fault_of(here, other.without(free), _nominal_error(nominal, known, other))
        for other in simplest(list(tried), most)
        if not {cause.kind for cause in other.causes} <= free
    )
    if not faults and not frames_only:
        faults = find_faults_as_drawn(model.robot, with_names_of(model, judged, fitted))
    return faults


def _nominal_error(nominal: CalibratedModel | None, some: Measurements, other: Hypothesis) -> float:
    """Compute the root mean square of the position errors [m] of the nominal robot under a hypothesis."""
    kinds = {cause.kind for cause in other.causes}
    if nominal is None or "correction" in kinds:
        return float("nan")
    T = poses_of_rows(nominal, replace(some, q=other.q))
    tried = in_frames(PredictingArm(nominal.robot, nominal), some, Hypothesis(other.q, T, other.measured))
    wanted = kinds & {"frame", "tool"}
    return next(one.rms()[0] for one in tried if {cause.kind for cause in one.causes} == wanted)


def judged_values(model: CalibratedModel, measurements: Measurements) -> Measurements:
    """Leave orientations out that a model does not know."""
    if has_orientation(model):
        return measurements
    return replace(measurements, rotation=None, sigma_rotation=None)


def is_implausible(figures: ModelFigures, model: CalibratedModel) -> bool:
    """Say whether errors of positions or of orientations are too large to be those of a calibrated robot.

    Args:
        figures: of the model, or of another with its base and tool.
        model: the model.
    """
    reach, orientation = model.robot.reach, figures.orientation if has_orientation(model) else None
    turn = 0.0 if orientation is None else np.deg2rad(orientation.statistics["rms"])
    return figures.position.statistics["rms"] * 1e-3 > PLAUSIBLE_SHARE * reach > 0 or turn > PLAUSIBLE_TURN


def unexplained(model: CalibratedModel) -> str:
    """Say of implausible errors of a model that no setup fault explains them, and what to check."""
    limit, turn = PLAUSIBLE_SHARE * model.robot.reach * 1e3, np.rad2deg(PLAUSIBLE_TURN)
    return (
        f"Errors of more than {limit:.3g} mm or {turn:.2g} deg are no calibration errors, but no usual setup fault "
        "(frame, tool, units, conventions of orientations, shifted rows, order, signs and zeros of the joints, "
        "correction applied twice or not at all) explains them; check whether this robot was measured, and whether the "
        "rows belong together."
    )

"""Check whether the sizes of the geometric errors are possible for the nominal robot and its class."""

import math
from collections.abc import Iterator, Sequence

from pisigma.calibration.geometric.parameter_table import PriorRatio
from pisigma.calibration.geometric.problem.parameters import direction_by_zero_parameter
from pisigma.calibration.geometric.problem.prior_scales import PriorGroup
from pisigma.robot.robot_class import CLASSES, SERVO, RobotClass
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.checks.setup_fault import setup_diagnostics
from pisigma.validation.held_out.diagnostic import Diagnostic

UNUSUAL = 4.0
"""Ratio of the lower bound of the errors to their prior standard deviation above which a warning is given. Healthy
robots have up to 4.6 times the default prior of 1 mrad."""
_IMPLAUSIBLE = 10.0
"""Ratio of the lower bound of the errors to their prior standard deviation above which the rows do not belong to this
robot: the odds against a normal error of 10 standard deviations are 1e23 to 1. The user can state a wider prior."""
PREDICTED_SHARE = 0.25
"""Share of the nominal robot's error below which the error of held-out rows is small, if it also meets
`PREDICTED_REACH`."""
PREDICTED_REACH = 0.005
"""Share of the reach below which the error of held-out rows is small, if it also meets `PREDICTED_SHARE`."""
NAMES = {
    PriorGroup.JOINT_OFFSET: "joint zeros",
    PriorGroup.LENGTH: "lengths",
    PriorGroup.NO_LENGTH: "lengths that are nominally 0",
    PriorGroup.BETWEEN_AXES: "angles between the axes",
}


def check_prior_ratio(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Compare the estimated sizes of the geometric errors with the prior and with the limits of the robot's class.

    If no class is stated, the limits are those of the narrowest class, starting with the manufacturer's, in which joint
    zeros of these sizes are possible. Joint zeros beyond the manufacturer's class are accepted if held-out rows are
    predicted well.
    """
    unusual = [ratio for ratio in checked.geometric.prior_ratios if ratio.lower_bound > UNUSUAL]
    large = [ratio for ratio in unusual if ratio.lower_bound > _IMPLAUSIBLE]
    possible = narrowest_robot_class(checked, large)
    usual = checked.robot_class
    for ratio in unusual:
        believed = ratio not in large or (
            possible is not None and (possible is usual or predicts_held_out_rows(checked))
        )
        yield Diagnostic(
            kind="prior_ratio",
            severity="warning" if believed else "implausible",
            sentence=f"The {NAMES[ratio.group]} are off by about {_size(ratio)}, {ratio.value:.2g} times their "
            f"prior standard deviation, {_consequence(ratio, usual, possible, believed)}.",
            cause=ratio.group.name.lower(),
            values={"ratio": ratio.value},
        )


def narrowest_robot_class(
    checked: CheckedCalibration, large_ratios: Sequence[PriorRatio]
) -> RobotClass | None:
    """Return the class of a robot with errors of these sizes: the stated class, or the narrowest that allows them.

    The search for the narrowest class starts with the manufacturer's class.

    A wider class than the manufacturer's is accepted for joint zeros only: lengths and angles of another class belong
    to another robot, unless the user states the class.

    Returns:
        The class; None if no class allows these errors.
    """
    usual = checked.robot_class
    sizes = [(ratio.group, ratio.error_sigma) for ratio in large_ratios]
    at_least = [(ratio.group, ratio.error_sigma_lower_bound) for ratio in large_ratios]
    if usual.allows(at_least) or checked.calibrator.robot_class is not None:
        return usual if usual.allows(at_least) else None
    if any(
        group != PriorGroup.JOINT_OFFSET
        for group, size in at_least
        if size > usual.max_error_sigmas.size_of(group)
    ):
        return None
    names = list(CLASSES)
    wider = [CLASSES[name] for name in names[names.index(usual.name) + 1 :]]
    return next((one for those in (sizes, at_least) for one in wider if one.allows(those)), None)


def predicts_held_out_rows(checked: CheckedCalibration) -> bool:
    """Return whether held-out rows are predicted far better than by the nominal robot.

    Without held-out rows, the errors of the rows of the calibration are used, scaled up for the degrees of freedom of
    the geometric calibration.
    """
    validation = checked.validation
    figures = checked.figures if validation is None else validation.figures()
    if figures is None or figures.nominal is None or figures.nominal.rms_mm is None:
        return False
    errors = list(figures.models.values())[-1].rms_mm
    if errors is None:
        return False
    if validation is None:
        values = sum(checked.geometric.solved.problem.measured_value_counts)
        spare = values - len(checked.geometric.solved.problem.active)
        errors *= math.sqrt(values / spare) if spare > 0 else math.inf
    return errors < PREDICTED_SHARE * figures.nominal.rms_mm and (
        errors < PREDICTED_REACH * checked.robot.reach * 1e3
    )


def _size(ratio: PriorRatio) -> str:
    unit = "mm" if ratio.kind == "length" else "mrad"
    return f"{ratio.error_sigma * 1e3:.2g} {unit}"


def _consequence(ratio: PriorRatio, usual: RobotClass, possible: RobotClass | None, believed: bool) -> str:
    if believed and (possible is usual or possible is None or ratio.lower_bound <= _IMPLAUSIBLE):
        return (
            "so the size of the prior was estimated from the data; check the nominal geometry and the robot, or give a "
            "wider prior"
        )
    if believed and possible is not None:
        return (
            f"which is usual for robots of class {possible.name}, not {usual.name}; held-out rows are predicted well, "
            f"so the size of the prior was estimated from the data; if this is right, use --set class={possible.name}"
        )
    if possible is None:
        return (
            f"which no robot of {'class ' + usual.name if usual is not SERVO else 'any class'} has; check that this "
            "robot was measured, the units, and the order and directions of the joints, or give a wider prior if such "
            "errors are expected"
        )
    return (
        f"which is usual for robots of class {possible.name}, but held-out rows are not predicted well; check that "
        "this robot was measured, the units, and the order and directions of the joints, or measure more rows"
    )


FAR = 8e-3
"""Deviation of a joint zero above which a warning is given [rad]; healthy industrial robots and cobots are within 3
mrad."""
_CERTAIN = 3.0
"""Margin above `FAR`, in standard errors."""


def check_joint_zero(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about joint zeros that are far off; a calibration cannot distinguish a wrong zero from a wrong log.

    With the nominal robot, large deviations are found as a setup fault. If the poses cover little of the workspace,
    base and tool absorb most of the effect, and only the estimated parameters show the deviations.
    """
    if setup_diagnostics(checked.robot, checked.rows):
        return
    usual = checked.robot_class
    far = usual.max_error_sigmas.joint_offset if usual is SERVO else FAR
    directions = direction_by_zero_parameter(checked.robot)
    for one in checked.geometric.parameters:
        joint = one.name.removeprefix("theta_")
        if joint == one.name or not one.free or abs(one.change) - _CERTAIN * one.standard_error < far:
            continue
        change = math.degrees(one.change) * directions.get(one.name, 1)
        yield Diagnostic(
            kind="joint_zero",
            severity="warning",
            sentence=f"The zero of joint {joint} is estimated {change:.3g} deg away from its nominal "
            f"value (standard error {math.degrees(one.standard_error):.2g} deg), more than is usual for "
            f"robots; check the zero of joint {joint} and how its values were logged (the calibration is valid "
            "for joint values that are logged in the same way).",
            values={"joint": joint, "change_deg": change},
        )

"""Whether the errors of the geometry are of a size that a robot of this drawing and class can have."""

import math
from collections.abc import Iterator, Sequence

from pisigma.calibration.geometric.problem.prior_sizes import PriorGroup
from pisigma.calibration.geometric.result import PriorRatio
from pisigma.robot.robot_class import CLASSES, RobotClass
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

UNUSUAL = 4.0
"""Errors that are surely more than so many times as large as the prior says are worth a warning. Healthy robots have
up to 4.6 times the default prior of 1 mrad."""
IMPLAUSIBLE = 10.0
"""Errors that are surely so many times as large as a prior that the user stated wider are not those of this robot: the
odds against one normal error of 10 standard deviations are 1 to 1e23."""
PREDICTED_SHARE = 0.25
"""Left-out rows are predicted well where this share of the errors of the robot as drawn is left, at most,"""
PREDICTED_REACH = 0.005
"""and not more than this share of the reach."""
NAMES = {
    PriorGroup.JOINT_OFFSET: "zeros of the joints",
    PriorGroup.LENGTH: "lengths",
    PriorGroup.NO_LENGTH: "lengths that are drawn as 0",
    PriorGroup.BETWEEN_AXES: "angles between the axes",
}


class PriorRatioCheck(AbstractCheck):
    """Compares the estimated sizes of the geometric errors with what the prior says and with the robot's class.

    The class that is not stated is found: the narrowest one, from that of the maker on, in which zeros of joints of
    these sizes are possible. Zeros larger than those of the maker's class are believed where left-out rows are
    predicted well.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        unusual = [ratio for ratio in checked.geometric.prior_ratios if ratio.at_least > UNUSUAL]
        large = [ratio for ratio in unusual if ratio.at_least > IMPLAUSIBLE]
        possible = class_of(checked, large)
        usual = _usual_class(checked)
        for ratio in unusual:
            believed = ratio not in large or (
                possible is not None and (possible is usual or predicts_left_out_rows(checked))
            )
            yield Diagnostic(
                kind="prior_ratio",
                severity="warning" if believed else "implausible",
                sentence=f"The {NAMES[ratio.group]} are off by about {_size(ratio)}, {ratio.value:.2g} times what the "
                f"prior says, {_consequence(ratio, usual, possible, believed)}.",
            )


def class_of(checked: CheckedCalibration, large: Sequence[PriorRatio]) -> RobotClass | None:
    """Find the class of a robot with errors of these sizes: the stated one, or the narrowest from its own on.

    A wider class than the maker's is believed of zeros of joints alone: lengths and angles of another class are those
    of another robot, unless the user states the class.
    """
    usual = _usual_class(checked)
    sizes = [(ratio.group, ratio.size) for ratio in large]
    at_least = [(ratio.group, ratio.size_at_least) for ratio in large]
    if usual.holds(at_least) or checked.calibrator.robot_class is not None:
        return usual if usual.holds(at_least) else None
    if any(group != PriorGroup.JOINT_OFFSET for group, size in at_least if size > usual.largest.of(group)):
        return None
    names = list(CLASSES)
    wider = [CLASSES[name] for name in names[names.index(usual.name) + 1 :]]
    return next((one for those in (sizes, at_least) for one in wider if one.holds(those)), None)


def predicts_left_out_rows(checked: CheckedCalibration) -> bool:
    """Say whether left-out rows are predicted far better than by the robot as drawn.

    Without left-out rows the errors of those that were calibrated with count, enlarged for the parameters that the
    geometric calibration used up.
    """
    validation = checked.validation
    figures = checked.figures if validation is None else validation.figures()
    if figures is None or figures.nominal is None or figures.nominal.rms_mm is None:
        return False
    errors = list(figures.models.values())[-1].rms_mm
    if errors is None:
        return False
    if validation is None:
        values = sum(checked.geometric.solved.problem.values_measured)
        spare = values - len(checked.geometric.solved.problem.active)
        errors *= math.sqrt(values / spare) if spare > 0 else math.inf
    return errors < PREDICTED_SHARE * figures.nominal.rms_mm and (
        errors < PREDICTED_REACH * checked.robot.reach * 1e3
    )


def _usual_class(checked: CheckedCalibration) -> RobotClass:
    stated = checked.calibrator.robot_class
    return RobotClass.of(checked.robot) if stated is None else CLASSES[stated]


def _size(ratio: PriorRatio) -> str:
    unit = "mm" if ratio.kind == "length" else "mrad"
    return f"{ratio.size * 1e3:.2g} {unit}"


def _consequence(ratio: PriorRatio, usual: RobotClass, possible: RobotClass | None, believed: bool) -> str:
    if believed and (possible is usual or possible is None or ratio.at_least <= IMPLAUSIBLE):
        return "so their size was taken from the data; check the nominal geometry and the robot, or give a wider prior"
    if believed and possible is not None:
        return (
            f"as of robots of class {possible.name}, not {usual.name}; left-out rows are predicted well, so their size "
            f"was taken from the data; if that is right, state --class {possible.name}"
        )
    if possible is None:
        return (
            f"which no robot of {'class ' + usual.name if usual.name != 'hobby' else 'any class'} has; check whether "
            "this robot was measured, its units, and order and directions of its joints, or give a wider prior if it "
            "is meant to be so far off"
        )
    return (
        f"as of robots of class {possible.name}, but left-out rows are not predicted well; check whether this robot "
        "was measured, its units, and order and directions of its joints, or measure more rows"
    )

"""Everything of a calibrated robot that can have moved by itself, each with its prior odds."""

import math
from dataclasses import replace

from pisigma.estimation.drift import DriftGroup
from pisigma.lifetime.recalibration.recalibration_problem import RecalibrationProblem

WORTH = math.log(100)
"""[nats] Prior odds of 1 to 100 that a thing moved since the calibration, against that nothing did."""


def hypotheses(problem: RecalibrationProblem) -> tuple[DriftGroup, ...]:
    """Everything that can have moved by itself: joints, bases, tools, single lengths and angles; or the correction.

    The correction stands for joints that err otherwise than before in many ways, which no single motion explains. Zeros
    of joints slip more often than arms are bent: all lengths together have a tenth of the odds of a joint, and so have
    all angles.
    """
    parameters = problem.design.problem.space.parameters
    single: list[DriftGroup] = []
    for group in problem.groups:
        if group.stands:
            continue
        if group.what not in ("lengths", "angles"):
            single.append(replace(group, worth=WORTH))
            continue
        for index, scale in zip(group.index, group.scale, strict=True):
            worth = WORTH + math.log(10 * len(group.index))
            single.append(DriftGroup(parameters[int(index)].name, index[None], scale[None], worth=worth))
    return tuple(single)

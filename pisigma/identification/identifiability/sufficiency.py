"""Whether measurements suffice for what is asked of them, and what to measure next where they do not."""

import numpy as np
import torch

from pisigma.errors import IdentificationError
from pisigma.identification.identifiability.redundancy import Redundancy
from pisigma.identification.problem.problem import CalibrationProblem
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot

LITTLE_MOTION = 0.1
"""[rad or m] A joint that moves less tells little."""
NEAR_AXIS = 5e-3
"""Share of the reach: a target nearer to the last axis hardly shows that joint's errors."""
GOOD_RATIO = 3
"""Values a parameter that a calibration should have."""


def check_poses(measurements: Measurements) -> None:
    """Refuse measurements that are all of one pose.

    Raises:
        IdentificationError: see above.
    """
    q = measurements.q
    if q.shape[0] > 1 and float((q - q[0]).abs().max()) < 1e-9:
        raise IdentificationError(
            f"{measurements.source}: all {q.shape[0]} rows are one pose, which tells the noise but no "
            "parameter; measure at other joint values, spread over the workspace."
        )


def check_sufficiency(
    robot: Robot,
    problem: CalibrationProblem,
    redundancy: Redundancy,
    explicit: bool,
    source: str,
    own: int = 0,
) -> tuple[str, ...]:
    """Refuse data that cannot determine the free parameters; warn of data that hardly do.

    Args:
        robot: with the tool that was found.
        problem: rows and sensors.
        redundancy: of the candidates at the start.
        explicit: whether the candidates were named one by one.
        source: what complaints call the data.
        own: number of the sensors' own unknowns, places of sockets and the like.

    Returns:
        Sentences that say what to measure next.

    Raises:
        IdentificationError: there are not more values than parameters.
    """
    wanted = len(redundancy.names) - len(redundancy.no_effect) if explicit else redundancy.rank
    wanted += own
    values = distinct_values(problem)
    per_row = values / max(distinct_rows(problem), 1)
    if values <= wanted:
        most = (
            len(redundancy.names) - len(redundancy.no_effect) + own
        )  # the rank is at most that of the few values
        missing = int(np.ceil((GOOD_RATIO * most - values) / per_row))
        raise IdentificationError(
            f"{source}: {distinct_rows(problem)} different poses give {values} values for {most} free "
            "parameters, which leaves nothing to tell noise from error; measure about "
            f"{missing} more poses, or free fewer parameters."
        )
    warnings = [*_still_joints(robot, problem), *_targets_on_axis(robot, problem)]
    if values < GOOD_RATIO * wanted:
        missing = int(np.ceil((GOOD_RATIO * wanted - values) / per_row))
        warnings.insert(
            0,
            f"{values} values are few for {wanted} free parameters; measure about {missing} more poses.",
        )
    return tuple(warnings)


def distinct_rows(problem: CalibrationProblem) -> int:
    """Number of rows that differ in joint values, frame or target."""
    return problem.q.shape[0] if problem.pose is None else int(problem.pose.max()) + 1


def distinct_values(problem: CalibrationProblem) -> int:
    """Number of measured values, repeats counted once."""
    share = distinct_rows(problem) / problem.q.shape[0]
    return round(sum(problem.values_seen) * share)


def _still_joints(robot: Robot, problem: CalibrationProblem) -> list[str]:
    """A sentence for every joint that hardly moves."""
    span = (problem.q.amax(0) - problem.q.amin(0)).tolist()
    found = []
    for joint, moved in zip(robot.joints, span, strict=True):
        if moved < LITTLE_MOTION:
            text = f"{np.rad2deg(moved):.3g} deg" if joint.type == "revolute" else f"{moved * 1e3:.3g} mm"
            found.append(
                f"joint {joint.name} moves by {text} only, so its errors cannot be told from its "
                "neighbours'; measure poses that move it through more of its range."
            )
    return found


def _targets_on_axis(robot: Robot, problem: CalibrationProblem) -> list[str]:
    """A sentence for every target that positions alone see too near to the last axis."""
    if any(sensor.turning for sensor in problem.sensors) or robot.joints[-1].type != "revolute":
        return []
    last = robot.joint_rows[-1]
    names, offs = [], []
    for name, tool in zip(problem.space.targets, problem.space.split(problem.nominal)[2].cpu(), strict=True):
        end = Robot(
            robot.name, robot.maker, robot.source, robot.rows[last:], robot.dh[last:], tool=tool.numpy()
        )
        T = forward_kinematics(end, torch.zeros(1, dtype=torch.float64))
        names.append(name)
        offs.append(float(torch.hypot(T[0, 3], T[1, 3])))
    if max(offs) >= NEAR_AXIS * robot.reach:
        return []
    which = f"target {names[int(np.argmax(offs))]}" if len(names) > 1 else "the target"
    return [
        f"{which} is {max(offs) * 1e3:.2g} mm from the axis of joint {robot.joints[-1].name}, so positions "
        "say next to nothing of that joint and of its axis; mount it "
        f"{0.05 * robot.reach * 1e3:.0f} mm or more beside the axis, or measure orientations too."
    ]

"""Check whether measurements are sufficient for the free parameters, and advise what to measure next."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from pisigma.calibration.geometric.identifiability.redundancy import Redundancy
from pisigma.calibration.geometric.problem.information import Information
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import CalibrationSetup
from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.sensors.intrinsics import SCALE_COLUMN, BoardScalePrior, IntrinsicsSensor, texts_of
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


@dataclass(frozen=True)
class CalibrationWarning:
    """A warning about something that measurements do not determine or that does not fit, with the action to take.

    Attributes:
        kind: kind of the warning.
        subject: name of the joint, target or frame concerned; empty if the warning concerns all measurements.
        sentence: the warning as a sentence.
    """

    kind: Literal[
        "few_values",
        "still_joint",
        "target_on_axis",
        "scale_of_boards",
        "scale_of_touches",
        "scale_of_sockets",
        "touched_frame",
        "floating_frame",
        "frame_misfit",
        "angle_disagreement",
    ]
    subject: str
    sentence: str


_LITTLE_MOTION = 0.1
"""Range of a joint [rad or m] below which its errors are hardly identifiable."""
_NEAR_AXIS = 5e-3
"""Distance of a target from the last axis, as a share of the reach, below which errors of this joint have little
effect."""
_GOOD_RATIO = 3
"""Number of values per parameter that a calibration should have."""
_MIN_EFFECT = 1e-3
"""Ratio of the length of a parameter's column to the longest one above which the parameter can determine the scale."""
_SAME_FACE = 1e-6
"""Largest difference of coordinates [m] on one face."""
_TOUCHES_WITHOUT_SCALE = (
    "in every frame, all touches along an axis are at one coordinate; a robot of any size fits them, so the scale "
    "stays nominal. Touch faces at different coordinates along an axis."
)
_SOCKETS_WITHOUT_SCALE = (
    "sockets alone fit a robot of any size, so the scale stays nominal; give the distance between two sockets "
    "(socket_distances), or measure a length with another sensor."
)


def count_estimated_unknowns(
    redundancy: Redundancy, named_individually: bool, sensor_unknown_count: int
) -> int:
    """Return the number of unknowns to estimate.

    Args:
        redundancy: redundancy of the candidates at the start.
        named_individually: whether the candidates were named individually.
        sensor_unknown_count: number of the sensors' unknowns, such as the positions of sockets.
    """
    acting = len(redundancy.names) - len(redundancy.no_effect)
    return (acting if named_individually else redundancy.rank) + sensor_unknown_count


def refuse_too_few(
    problem: CalibrationProblem,
    redundancy: Redundancy,
    named_individually: bool,
    sensor_unknown_count: int,
    source: str,
) -> None:
    """Refuse data that are too few to determine the free parameters.

    Args:
        problem: rows and sensors.
        redundancy: see `count_estimated_unknowns`.
        named_individually: see `count_estimated_unknowns`.
        sensor_unknown_count: see `count_estimated_unknowns`.
        source: name of the data in error messages.

    Raises:
        IdentificationError: there are not more values than parameters.
    """
    values = distinct_values(problem)
    if values > count_estimated_unknowns(redundancy, named_individually, sensor_unknown_count):
        return
    # The rank cannot be used, because it is at most the number of values.
    most = count_estimated_unknowns(redundancy, True, sensor_unknown_count)
    raise IdentificationError(
        f"expected more values than the {most} free parameters, got {values} values from {distinct_rows(problem)} "
        "different poses",
        expected=f"more than {most} values",
        value=values,
        at=Place(source),
        remedy=f"measure about {_missing_poses(problem, most)} more poses, or free fewer parameters",
    )


def measurement_advice(setup: CalibrationSetup, estimated_count: int) -> tuple[CalibrationWarning, ...]:
    """Return warnings about free parameters that the data hardly determine, with advice on what to measure next.

    Args:
        setup: the problem at its start.
        estimated_count: number of unknowns to estimate.
    """
    problem = setup.problem
    values = distinct_values(problem)
    few = []
    if values < _GOOD_RATIO * estimated_count:
        sentence = (
            f"there are only {values} values for {estimated_count} free parameters; measure about "
            f"{_missing_poses(problem, estimated_count)} more poses."
        )
        few.append(CalibrationWarning("few_values", "", sentence))
    robot = problem.space.robot
    return (
        *few,
        *_unexcited_joints(robot, problem),
        *_targets_on_axis(robot, problem),
        *_undetermined(setup),
    )


def _missing_poses(problem: CalibrationProblem, estimated_count: int) -> int:
    values = distinct_values(problem)
    return int(np.ceil((_GOOD_RATIO * estimated_count - values) / (values / max(distinct_rows(problem), 1))))


def distinct_rows(problem: CalibrationProblem) -> int:
    """Return the number of rows that differ in joint values, frame or target."""
    return problem.q.shape[0] if problem.pose is None else int(problem.pose.max()) + 1


def distinct_values(problem: CalibrationProblem) -> int:
    """Return the number of measured values, with repeats counted once."""
    share = distinct_rows(problem) / problem.q.shape[0]
    return round(sum(problem.measured_value_counts) * share)


def _unexcited_joints(robot: Robot, problem: CalibrationProblem) -> list[CalibrationWarning]:
    """Yield a warning for every joint that hardly moves."""
    span = (problem.q.amax(0) - problem.q.amin(0)).tolist()
    warnings = []
    for joint, moved in zip(robot.joints, span, strict=True):
        if moved < _LITTLE_MOTION:
            text = f"{np.rad2deg(moved):.3g} deg" if joint.type == "revolute" else f"{moved * 1e3:.3g} mm"
            sentence = (
                f"joint {joint.name} moves by only {text}, so its errors cannot be distinguished from those of its "
                "neighbours; measure poses over more of its range."
            )
            warnings.append(CalibrationWarning("still_joint", joint.name, sentence))
    return warnings


def _targets_on_axis(robot: Robot, problem: CalibrationProblem) -> list[CalibrationWarning]:
    """Yield a warning if all targets are too near to the last axis and only positions were measured."""
    if any(sensor.depends_on_rotation for sensor in problem.sensors) or robot.joints[-1].type != "revolute":
        return []
    last = robot.joint_rows[-1]
    names, offs = [], []
    for name, tool in zip(
        problem.space.targets, problem.space.split(problem.prior_mean)[2].cpu(), strict=True
    ):
        end = Robot(
            robot.name, robot.maker, robot.source, robot.rows[last:], robot.dh[last:], tool=tool.numpy()
        )
        T = forward_kinematics(end, torch.zeros(1, dtype=torch.float64))
        names.append(name)
        offs.append(float(torch.hypot(T[0, 3], T[1, 3])))
    if max(offs) >= _NEAR_AXIS * robot.reach:
        return []
    which = f"target {names[int(np.argmax(offs))]}" if len(names) > 1 else "the target"
    sentence = (
        f"{which} is {max(offs) * 1e3:.2g} mm from the axis of joint {robot.joints[-1].name}, so positions hardly "
        f"depend on the errors of this joint and its axis; mount it at least {0.05 * robot.reach * 1e3:.0f} mm away "
        "from the axis, or measure orientations too."
    )
    return [CalibrationWarning("target_on_axis", robot.joints[-1].name, sentence)]


def _undetermined(setup: CalibrationSetup) -> tuple[CalibrationWarning, ...]:
    """Yield warnings about what a setup cannot determine with any poses, and what to measure instead."""
    return (*_scale(setup), *_touched_frames(setup), *_floating_frames(setup))


def determines_scale(setup: CalibrationSetup) -> bool:
    """Return whether the measurements determine the scale.

    Sockets fit a robot of any size; touches determine lengths if faces have different coordinates. Orientations alone
    do not determine the scale, but lengths then have no effect either, so no length has to be fixed.
    """
    data = setup.measurements
    lengths = _lengths(setup)
    if not lengths or lengths - {"touch", "socket"}:
        return True
    faces: dict[tuple[str, str], list[float]] = {}
    if data.touch is not None and data.touch_axis is not None:
        for frame, axis, value in zip(data.frame, data.touch_axis, data.touch.tolist(), strict=True):
            if axis:
                faces.setdefault((frame, axis), []).append(value)
    return any(max(values) - min(values) > _SAME_FACE for values in faces.values())


def candidates_with_fixed_scale(
    setup: CalibrationSetup, candidates: list[int], information: Information
) -> tuple[list[int], Information]:
    """Compute the information on the candidates at the start, with the sensors' unknowns eliminated.

    If the data do not determine the scale, the longest length with an effect keeps its nominal value. Otherwise
    errors of the nominal geometry would seem to determine the scale, and a robot that shrinks to a point would fit
    all sockets.

    Args:
        setup: the problem at its start.
        candidates: indices of the parameters that may be estimated.
        information: information on the sensors' unknowns and the candidates.

    Returns:
        The candidates, without the length that sets the scale, and the information on them.
    """
    at_start = without_sensor_unknowns(setup, information)
    if determines_scale(setup):
        return candidates, at_start
    size = np.linalg.norm(at_start.jacobian, axis=0)
    values = np.abs(setup.start.cpu().numpy()[candidates])
    arm = [parameter.group in ("d", "a") for parameter in at_start.parameters]
    lengths = np.where(np.array(arm) & (size > _MIN_EFFECT * size.max(initial=0.0)), values, 0.0)
    if not lengths.any():
        return candidates, at_start
    longest = int(lengths.argmax())
    return [i for i in candidates if i != candidates[longest]], at_start.without_parameter(longest)


def without_sensor_unknowns(setup: CalibrationSetup, information: Information) -> Information:
    """Eliminate the sensors' unknowns, and set the columns of floating bases to zero.

    Measurements in a floating frame do not change if base and sensors move together. The first-order change of a
    socket's residuals by such a motion is not zero, but a mere rotation of the residuals, so it would seem to determine
    a base, or joint 1.
    """
    parameters = setup.problem.space.names
    unknowns, floating = (
        {parameters[i] for i in indices} for indices in (setup.free_unknowns, floating_bases(setup))
    )
    names = information.names
    return information.eliminate(
        [i for i, name in enumerate(names) if name in unknowns],
        [i for i, name in enumerate(names) if name in floating],
    )


def _scale_of_boards(setup: CalibrationSetup) -> str:
    """Yield a warning if only boards determine the scale, stating how accurately they do so."""
    stated = [float(text) for text in texts_of(setup.measurements, SCALE_COLUMN) if text]
    how_sure = (
        f"the stated standard deviation of its squares is {max(stated):.2g} of their length, or "
        f"{max(stated) * setup.problem.space.robot.reach * 1e3:.2g} mm at the reach of the robot"
        if stated
        else "the standard deviation of its squares is not stated (square_sigma_mm), so no predicted error includes it"
    )
    return (
        "only the board determines the scale: if its squares are 0.1 % too large, so is the robot, and no residual "
        f"shows it; {how_sure}. Measure the board with a calliper, or measure one known distance with another sensor."
    )


def _lengths(setup: CalibrationSetup) -> set[str]:
    """Return the sensors that measure lengths."""
    stated = (IntrinsicsSensor.name, BoardScalePrior.name)
    return {
        sensor.name for sensor in setup.problem.sensors if sensor.unit == "m" and sensor.name not in stated
    }


def _scale(setup: CalibrationSetup) -> list[CalibrationWarning]:
    if _lengths(setup) == {"corner"}:
        return [CalibrationWarning("scale_of_boards", "", _scale_of_boards(setup))]
    if determines_scale(setup):
        return []
    if "touch" in setup.measurements.kinds:
        return [CalibrationWarning("scale_of_touches", "", _TOUCHES_WITHOUT_SCALE)]
    return [CalibrationWarning("scale_of_sockets", "", _SOCKETS_WITHOUT_SCALE)]


def _touched_frames(setup: CalibrationSetup) -> list[CalibrationWarning]:
    """Yield a warning for every frame that is touched along some axes only."""
    data = setup.measurements
    if data.touch is None or data.touch_axis is None or not setup.problem.space.indices_of("base"):
        return []
    other = (data.is_measured("position") | data.is_measured("pose")).tolist()
    warnings = []
    for frame in setup.problem.space.frames:
        rows = [row for row, name in enumerate(data.frame) if name == frame]
        axes = {data.touch_axis[row] for row in rows if data.touch_axis[row]}
        lacking = [axis for axis in "xyz" if axis not in axes]
        if axes and lacking and not any(other[row] for row in rows):
            sentence = (
                f"frame '{frame}' was touched only along {' and '.join(sorted(axes))}, so its position along "
                f"{' and '.join(lacking)} is not determined; also touch faces that are normal to "
                f"{'this axis' if len(lacking) == 1 else 'these axes'}."
            )
            warnings.append(CalibrationWarning("touched_frame", frame, sentence))
    return warnings


def floating_frames(setup: CalibrationSetup) -> list[str]:
    """Return the frames without a measurement at a stated position, in which everything may move together."""
    data, sensors = setup.measurements, setup.problem.sensors
    if all(sensor.determines_frame for sensor in sensors):
        return []
    held = torch.stack([sensor.present & sensor.determines_frame for sensor in sensors]).any(0)
    if data.anchor_place is not None:
        held |= torch.isfinite(data.anchor_place).all(-1)
    holding = {frame for frame, holds in zip(data.frame, held.tolist(), strict=True) if holds}
    return [frame for frame in setup.problem.space.frames if frame not in holding]


def floating_bases(setup: CalibrationSetup) -> list[int]:
    """Return the indices of the parameters of bases in floating frames, which keep their start values."""
    space, floating = setup.problem.space, floating_frames(setup)
    return [
        index
        for number, name in enumerate(space.frames)
        if name in floating
        for index in space.indices_of("base")[6 * number : 6 * number + 6]
    ]


def _floating_frames(setup: CalibrationSetup) -> list[CalibrationWarning]:
    floating = floating_frames(setup)
    if not floating:
        return []
    names = " and ".join(f"'{frame}'" for frame in floating)
    where = f"frame{'s' if len(floating) > 1 else ''} {names}" if any(floating) else "the measuring frame"
    sentence = (
        f"no measurement in {where} has a stated position, so the pose of the robot's base there is not determined: "
        "predicted positions are correct relative to each other, up to a common rigid motion; measure three positions, "
        "touches, or distances from anchors at stated positions."
    )
    return [CalibrationWarning("floating_frame", ", ".join(floating), sentence)]

"""Whether measurements suffice for what is asked of them, what they cannot determine, and what to measure next."""

import numpy as np
import torch

from pisigma.calibration.geometric.identifiability.redundancy import Redundancy
from pisigma.calibration.geometric.problem.information import Information
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import CalibrationSetup
from pisigma.files.errors import IdentificationError
from pisigma.measurement.sensors.intrinsics import SCALE_COLUMN, BoardScaleSensor, IntrinsicsSensor, texts_of
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

LITTLE_MOTION = 0.1
"""[rad or m] A joint that moves less hardly shows its errors."""
NEAR_AXIS = 5e-3
"""Share of the reach: a target nearer to the last axis hardly shows that joint's errors."""
GOOD_RATIO = 3
"""Values a parameter that a calibration should have."""
SEEN_AT_ALL = 1e-3
"""A length whose column is shorter than this share of the longest does not hold the scale."""
SAME_FACE = 1e-6
"""[m] Coordinates within this are of one face."""
TOUCHES_WITHOUT_SCALE = (
    "the touches of every frame and axis are at one coordinate, which a robot of any size can meet, so the scale stays "
    "as drawn; touch faces at different coordinates along an axis."
)
SOCKETS_WITHOUT_SCALE = (
    "sockets alone are met by a robot of any size, so the scale stays as drawn; give the distance between two sockets "
    "(socket_distances), or measure one length otherwise."
)


def free_parameters(redundancy: Redundancy, explicit: bool, unknowns: int) -> int:
    """Return how many numbers have to be estimated.

    Args:
        redundancy: of the candidates at the start.
        explicit: whether the candidates were named one by one.
        unknowns: number of the sensors' unknowns, such as where sockets are.
    """
    acting = len(redundancy.names) - len(redundancy.no_effect)
    return (acting if explicit else redundancy.rank) + unknowns


def refuse_too_few(
    problem: CalibrationProblem, redundancy: Redundancy, explicit: bool, unknowns: int, source: str
) -> None:
    """Refuse data that cannot determine the free parameters.

    Args:
        problem: rows and sensors.
        redundancy: see `free_parameters`, as for the next two.
        explicit: see there.
        unknowns: see there.
        source: what complaints call the data.

    Raises:
        IdentificationError: there are not more values than parameters.
    """
    values = distinct_values(problem)
    if values > free_parameters(redundancy, explicit, unknowns):
        return
    # not the rank, which is at most that of the few values
    most = free_parameters(redundancy, True, unknowns)
    raise IdentificationError(
        f"{source}: {distinct_rows(problem)} different poses give {values} values for {most} free "
        "parameters, which leaves nothing to distinguish noise from error; measure about "
        f"{_missing_poses(problem, most)} more poses, or free fewer parameters."
    )


def what_to_measure(setup: CalibrationSetup, wanted: int) -> tuple[str, ...]:
    """Say what to measure next, in sentences, where the data hardly determine what is free.

    Args:
        setup: the problem at its start.
        wanted: how many numbers have to be estimated.
    """
    problem = setup.problem
    values = distinct_values(problem)
    few = []
    if values < GOOD_RATIO * wanted:
        few.append(
            f"{values} values are few for {wanted} free parameters; measure about "
            f"{_missing_poses(problem, wanted)} more poses."
        )
    robot = problem.space.robot
    return (*few, *_still_joints(robot, problem), *_targets_on_axis(robot, problem), *_undetermined(setup))


def _missing_poses(problem: CalibrationProblem, wanted: int) -> int:
    values = distinct_values(problem)
    return int(np.ceil((GOOD_RATIO * wanted - values) / (values / max(distinct_rows(problem), 1))))


def distinct_rows(problem: CalibrationProblem) -> int:
    """Number of rows that differ in joint values, frame or target."""
    return problem.q.shape[0] if problem.pose is None else int(problem.pose.max()) + 1


def distinct_values(problem: CalibrationProblem) -> int:
    """Number of measured values, repeats counted once."""
    share = distinct_rows(problem) / problem.q.shape[0]
    return round(sum(problem.values_measured) * share)


def _still_joints(robot: Robot, problem: CalibrationProblem) -> list[str]:
    """A sentence for every joint that hardly moves."""
    span = (problem.q.amax(0) - problem.q.amin(0)).tolist()
    sentences = []
    for joint, moved in zip(robot.joints, span, strict=True):
        if moved < LITTLE_MOTION:
            text = f"{np.rad2deg(moved):.3g} deg" if joint.type == "revolute" else f"{moved * 1e3:.3g} mm"
            sentences.append(
                f"joint {joint.name} moves by {text} only, so its errors cannot be distinguished from its "
                "neighbours'; measure poses that move it through more of its range."
            )
    return sentences


def _targets_on_axis(robot: Robot, problem: CalibrationProblem) -> list[str]:
    """A sentence for targets that are all too near to the last axis, where positions alone are measured."""
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
        "say next to nothing about that joint and its axis; mount it "
        f"{0.05 * robot.reach * 1e3:.0f} mm or more beside the axis, or measure orientations too."
    ]


def _undetermined(setup: CalibrationSetup) -> tuple[str, ...]:
    """Say what a set-up cannot determine whatever its poses are, and what to measure for it."""
    return (*_scale(setup), *_touched_frames(setup), *_floating_frames(setup))


def determines_scale(setup: CalibrationSetup) -> bool:
    """Say whether any length was measured.

    Sockets are met by a robot of any size; touches determine lengths by faces at different coordinates. Orientations
    alone do not, but do not pretend to.
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
    return any(max(values) - min(values) > SAME_FACE for values in faces.values())


def candidates_at_start(
    setup: CalibrationSetup, candidates: list[int], information: Information
) -> tuple[list[int], Information]:
    """What the data say of the candidates at the start, after the sensors' own unknowns.

    Where they do not determine the scale, the longest length that they see keeps its nominal value: errors of the
    nominal geometry would pretend to determine it, and a robot that shrinks to a point meets all sockets.

    Args:
        setup: the problem at its start.
        candidates: indices of the parameters that may be estimated.
        information: of the sensors' unknowns and of them.
    """
    at_start = after_unknowns(setup, information)
    if determines_scale(setup):
        return candidates, at_start
    size = np.linalg.norm(at_start.jacobian, axis=0)
    values = np.abs(setup.start.cpu().numpy()[candidates])
    arm = [parameter.group in ("d", "a") for parameter in at_start.parameters]
    lengths = np.where(np.array(arm) & (size > SEEN_AT_ALL * size.max(initial=0.0)), values, 0.0)
    if not lengths.any():
        return candidates, at_start
    longest = int(lengths.argmax())
    return [i for i in candidates if i != candidates[longest]], at_start.without(longest)


def after_unknowns(setup: CalibrationSetup, information: Information) -> Information:
    """What is left for arm, bases and tools after the sensors' own unknowns; of floating bases nothing.

    What was measured in a floating frame is met as well after any motion of base and sensors together. The first-order
    change of a socket's residuals by such a motion is not zero, but it only turns them; so it would pretend to
    determine a base, or joint 1.
    """
    parameters = setup.problem.space.names
    unknowns, floating = (
        {parameters[i] for i in indices} for indices in (setup.free_unknowns, floating_bases(setup))
    )
    names = information.names
    return information.after(
        [i for i, name in enumerate(names) if name in unknowns],
        [i for i, name in enumerate(names) if name in floating],
    )


def _scale_of_boards(setup: CalibrationSetup) -> str:
    """Say that nothing but boards gives the scale, and how sure it is."""
    stated = [float(text) for text in texts_of(setup.measurements, SCALE_COLUMN) if text]
    how_sure = (
        f"its squares are stated to {max(stated):.2g} of their length, which is "
        f"{max(stated) * setup.problem.space.robot.reach * 1e3:.2g} mm at the reach of the robot"
        if stated
        else "how sure its squares are is not stated (square_sigma_mm), so no predicted error contains it"
    )
    return (
        "every length rests on the board that the camera sees: if its squares are 0.1 % too large, so is the robot, "
        f"and no residual shows it; {how_sure}. Measure the board with a calliper, or one known distance with another "
        "sensor."
    )


def _lengths(setup: CalibrationSetup) -> set[str]:
    """Names of the sensors that measure lengths, or state them."""
    stated = (IntrinsicsSensor.name, BoardScaleSensor.name)
    return {
        sensor.name for sensor in setup.problem.sensors if sensor.unit == "m" and sensor.name not in stated
    }


def _scale(setup: CalibrationSetup) -> list[str]:
    if _lengths(setup) == {"corner"}:
        return [_scale_of_boards(setup)]
    if determines_scale(setup):
        return []
    return [TOUCHES_WITHOUT_SCALE if "touch" in setup.measurements.kinds else SOCKETS_WITHOUT_SCALE]


def _touched_frames(setup: CalibrationSetup) -> list[str]:
    """A sentence for every frame that is touched along some axes only."""
    data = setup.measurements
    if data.touch is None or data.touch_axis is None or not setup.problem.space.of("base"):
        return []
    other = (data.measured("position") | data.measured("pose")).tolist()
    sentences = []
    for frame in setup.problem.space.frames:
        rows = [row for row, name in enumerate(data.frame) if name == frame]
        axes = {data.touch_axis[row] for row in rows if data.touch_axis[row]}
        lacking = [axis for axis in "xyz" if axis not in axes]
        if axes and lacking and not any(other[row] for row in rows):
            sentences.append(
                f"frame '{frame}' was touched along {' and '.join(sorted(axes))} only, so where it stands along "
                f"{' and '.join(lacking)} is not determined; touch faces that are square to "
                f"{'it' if len(lacking) == 1 else 'them'} too."
            )
    return sentences


def floating_frames(setup: CalibrationSetup) -> list[str]:
    """Name the frames in which nothing measured has a stated position: whatever is there may move as a whole."""
    data, sensors = setup.measurements, setup.problem.sensors
    if all(sensor.holds_frame for sensor in sensors):
        return []
    held = torch.stack([sensor.present & sensor.holds_frame for sensor in sensors]).any(0)
    if data.anchor_place is not None:
        held |= torch.isfinite(data.anchor_place).all(-1)
    holding = {frame for frame, holds in zip(data.frame, held.tolist(), strict=True) if holds}
    return [frame for frame in setup.problem.space.frames if frame not in holding]


def floating_bases(setup: CalibrationSetup) -> list[int]:
    """Indices of the parameters of bases in floating frames, which stay where they start."""
    space, floating = setup.problem.space, floating_frames(setup)
    return [
        index
        for number, name in enumerate(space.frames)
        if name in floating
        for index in space.of("base")[6 * number : 6 * number + 6]
    ]


def _floating_frames(setup: CalibrationSetup) -> list[str]:
    floating = floating_frames(setup)
    if not floating:
        return []
    names = " and ".join(f"'{frame}'" for frame in floating)
    where = f"frame{'s' if len(floating) > 1 else ''} {names}" if any(floating) else "the frame"
    return [
        f"nothing that was measured in {where} has a stated position, so where the robot's base is there is not "
        "determined: predicted positions are right among each other, up to one motion of them all; measure three "
        "positions, touches, or distances from anchors at stated positions for that."
    ]

"""Hypotheses that are tried as explanations of large errors, and the choice among them."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.csv.columns import MISNAMED_UNITS, RPY
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.model.calibrated_model import (
    CalibratedModel,
    bases_of_rows,
    nominal_poses_of_rows,
    poses_of_rows,
)
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import (
    LEVER_SHARE,
    MeasuredPoses,
    best_base,
    best_base_and_tool,
    best_tool,
    smallest_error,
)
from pisigma.robot.robot_class import plausible_error_per_reach
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.setup_faults.cause import Cause, length_text
from pisigma.validation.setup_faults.hypothesis import (
    COLLAPSED,
    Hypothesis,
    PredictingArm,
    mean_squared_error,
)
from pisigma.validation.setup_faults.joint_faults import NEAR_BEST, NOTICED, joint_causes, likely_maps

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_SMALL_SHARE = 2e-4
"""Errors, as a share of the reach, below which a fault of a joint column is not their cause."""
AS_GOOD = 1.5
"""Ratio of the errors of a simpler explanation to the smallest errors, up to which the simpler one is chosen."""
_MAX_CONVENTIONS = 8
"""Number of promising conventions of orientations that are tried with the whole model."""
_MIN_TURN = 0.01
"""Smallest rotation of a base or a tool that is reported [deg]."""
_MOVED = {
    "frame": (
        "base",
        "the robot or the sensor has been moved since the model was made; run again with --fit-frame, or "
        "recalibrate with --moved base",
    ),
    "tool": (
        "tool",
        "another tool or target is mounted, or another point of it was measured; run again with --fit-tool, or "
        "recalibrate with --moved tool",
    ),
}
_EULER_ORDERS = ("ZYX", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYZ", "ZXZ", "XYX", "XZX", "YXY", "YZY")
_READ_ORDER = _EULER_ORDERS[0]
"""Order of the rotations by roll, pitch and yaw in measurement files."""
_MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
_MIRRORED = "{} mirrored, as in a left-handed frame (an axis has the wrong sign, or two are swapped)"


def plausible_orientation_error(robot: Robot) -> float:
    """Return the largest orientation errors of a calibrated robot [rad].

    They are treated as position errors at a distance of `LEVER_SHARE` of the reach.
    """
    return plausible_error_per_reach(robot) / LEVER_SHARE


def max_explained_error(as_stated: Hypothesis, robot: Robot) -> float:
    """Return the largest error [m] that an explanation may leave."""
    return min(COLLAPSED * as_stated.error, plausible_error_per_reach(robot) * robot.reach)


def choose_simplest(fault_hypotheses: Sequence[Hypothesis], max_error: float) -> list[Hypothesis]:
    """Return the simplest hypothesis among those that explain the errors, up to `max_error` [m], about equally well.

    The remaining errors must also be small relative to the spread of the poses, which a wrong unit can shrink.
    """
    explaining = [
        other
        for other in fault_hypotheses
        if other.error <= max_error and other.error <= COLLAPSED * other.measured.spread
    ]
    best = min((other.error for other in explaining), default=0.0)
    explaining = [other for other in explaining if other.error <= AS_GOOD * best]
    simplest = min((other.complexity for other in explaining), default=0.0)
    chosen: dict[object, Hypothesis] = {}
    for other in sorted((o for o in explaining if o.complexity <= simplest), key=lambda other: other.error):
        chosen.setdefault(tuple((cause.kind, cause.joints) for cause in other.causes), other)
    return list(chosen.values())


def fault_hypotheses(
    arm: PredictingArm, rows: Measurements, as_stated: Hypothesis, max_error: float
) -> Iterator[Hypothesis]:
    """Yield the hypotheses that may explain the errors up to `max_error` [m]; the first is that nothing is wrong."""
    return frame_hypotheses(arm, rows, list(_faults_in_frames(arm, rows, as_stated)), max_error)


def _faults_in_frames(arm: PredictingArm, some: Measurements, here: Hypothesis) -> Iterator[Hypothesis]:
    """Yield the hypotheses of `fault_hypotheses` with the given frame and tool."""
    yield here
    for measured, cause in measured_pose_faults(here.measured, here.T[:, :3, 3], "corner" in some.kinds):
        yield replace(here, measured=measured, causes=(cause,))
    if arm.model is not None:
        for T, cause in _other_corrections(arm.model, some):
            yield here.with_cause(cause, T, fitted_parameters=0)
    if not here.error > _SMALL_SHARE * arm.robot.reach:
        return
    for measured, cause in _likely_conventions(arm, here):
        yield replace(here, measured=measured, causes=(cause,))
    maps = likely_maps(arm, some, here.measured)
    if len(maps.matrix) == 0:
        return
    q = maps.apply(some.q)
    T = arm.poses_at(q, some)
    for number in torch.isfinite(T).flatten(1).all(1).nonzero()[:, 0].tolist():
        yield Hypothesis(q[number], T[number], here.measured, joint_causes(maps, number, arm.robot), 1)


def _likely_conventions(arm: PredictingArm, here: Hypothesis) -> Iterator[tuple[MeasuredPoses, Cause]]:
    """Yield conventions of orientations that may explain the errors."""
    turned = here.measured.has_rotation
    if not bool(turned.any()):
        return
    eye = torch.eye(3).to(here.T)
    tried = list(other_conventions(here.measured.rotation))
    R = torch.where(turned[:, None, None], torch.stack([rotation for rotation, _, _ in tried]), eye)
    for mode in arm.fits_of_frames:
        errors = mean_squared_error(mode, here.T, replace(here.measured, rotation=R))
        limit = max(NEAR_BEST**2 * float(errors.min()), NOTICED**2)
        for number in errors.argsort()[:_MAX_CONVENTIONS].tolist():
            if float(errors[number]) <= limit:
                advice = "write orientations as described in the documentation of measurement files"
                _, clause, size = tried[number]
                yield replace(here.measured, rotation=R[number]), Cause("rotation", clause, advice, size)


def _other_corrections(
    model: CalibratedModel, some: Measurements
) -> Iterator[tuple[Float64[Tensor, "rows 4 4"], Cause]]:
    """Yield poses predicted with the correction applied once more and once less than logged (to first order)."""
    T, T_nominal = poses_of_rows(model, some), nominal_poses_of_rows(model, some)
    clause = "the rows fit the nominal robot at the joint values of the file"
    advice = (
        "either the log contains joint values from before the correction, or they were corrected again before they "
        "reached the robot, or the model belongs to another robot"
    )
    yield T_nominal, Cause("correction", clause, advice, 1.0, amount=1.0)
    T_less = T.clone()
    T_less[:, :3, 3] = 2 * T[:, :3, 3] - T_nominal[:, :3, 3]
    T_less[:, :3, :3] = T[:, :3, :3] @ T_nominal[:, :3, :3].mT @ T[:, :3, :3]
    clause = "the robot ran without the correction that the joint values of the file contain"
    advice = "the log contains corrected joint values, but the robot was sent to the uncorrected ones"
    yield T_less, Cause("correction", clause, advice, 1.0, amount=-1.0)


def frame_hypotheses(
    arm: PredictingArm, rows: Measurements, hypotheses: Sequence[Hypothesis], max_error: float = math.inf
) -> Iterator[Hypothesis]:
    """Yield hypotheses unchanged, with another frame, tool, and both; without a model, both are always fitted.

    Both are fitted only if an affine fit, which is a lower bound of the errors, leaves at most `max_error` [m]. With a
    model, other frames and tools that leave more are left out.

    Args:
        arm: the predicting arm.
        rows: the rows; not used without a model, because every hypothesis may have other rows.
        hypotheses: the hypotheses.
        max_error: largest error that an explanation may leave [m].
    """
    if arm.model is None:
        for here, base, tool in _with_frames_fitted(hypotheses, max_error):
            yield replace(here, T=base @ here.T @ tool)
        return
    frames, targets, bases = (
        numbers_of_names(rows.frame),
        numbers_of_names(rows.target),
        bases_of_rows(arm.model, rows),
    )
    count, tools = int(frames.max()) + 1, int(targets.max()) + 1

    def moved(here: Hypothesis, T: Tensor, fitted_parameters: int, **motions: Tensor) -> Iterator[Hypothesis]:
        other = replace(here, T=T, fitted_parameters=here.fitted_parameters + fitted_parameters)
        if other.error <= max_error:
            causes = [_moved(kind, X, bases if kind == "frame" else None) for kind, X in motions.items()]
            yield replace(other, causes=(*here.causes, *causes))

    for here in hypotheses:
        yield here
        X, Y = _per_group(best_base, frames, here), _per_group(best_tool, targets, here)
        yield from moved(here, X @ here.T, 6 * count, frame=X)
        yield from moved(here, here.T @ Y, here.tool_value_count * tools, tool=Y)
    for here, base, tool in _with_frames_fitted(hypotheses, max_error) if count == tools == 1 else ():
        fitted = 6 + here.tool_value_count
        yield from moved(here, base @ here.T @ tool, fitted, frame=base[None], tool=tool[None])


def _with_frames_fitted(
    tried: Sequence[Hypothesis], most: float
) -> Iterator[tuple[Hypothesis, Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]]]:
    """Fit base and tool under all hypotheses at once, and yield those with errors up to `most` [m]."""
    groups: dict[tuple[bool, ...], list[Hypothesis]] = {}
    for here in tried:
        groups.setdefault(tuple(here.measured.has_rotation.tolist()), []).append(here)
    for group in groups.values():
        T, measured = (
            torch.stack([here.T for here in group]),
            MeasuredPoses.stack([h.measured for h in group]),
        )
        likely = ~(smallest_error(T, measured) > most)
        group = list(itertools.compress(group, likely.tolist()))
        T, measured = T[likely], measured.select_batches(likely)
        yield from zip(group, *best_base_and_tool(T, measured), strict=True)


def _per_group(
    fit: Callable[[Tensor, MeasuredPoses], Tensor], group: Int64[Tensor, " rows"], here: Hypothesis
) -> Float64[Tensor, "rows 4 4"]:
    """Fit the transform of every frame or target, and return it for every row."""
    X = torch.empty_like(here.T)
    for number in range(int(group.max()) + 1):
        rows = group == number
        X[rows] = fit(here.T[rows], here.measured.select(rows))
    return X


def _moved(
    kind: str, X: Float64[Tensor, "#rows 4 4"], frames: Float64[Tensor, "#rows 4 4"] | None = None
) -> Cause:
    """Return the cause "a frame or tool has moved", with the largest motion of its origin.

    Args:
        kind: "frame" or "tool".
        X: motions of the frame or tool.
        frames: poses before the motion, in the coordinates of `jacobian`; None for the origin.
    """
    what, advice = _MOVED[kind]
    origin = torch.zeros(3, 1).to(X) if frames is None else frames[:, :3, 3:]
    shift = (X[:, :3, :3] @ origin + X[:, :3, 3:] - origin).norm(dim=1).max()
    turn = float(torch.rad2deg(rotation_vector(X[:, :3, :3]).norm(dim=-1)).max())
    motion = length_text(float(shift)) + (f" and {turn:.3g} deg" if turn > _MIN_TURN else "")
    clause = f"the {what} has moved by about {motion} relative to the model"
    return Cause(kind, clause, advice, 2.0, amount=float(shift))


def measured_pose_faults(
    measured: MeasuredPoses, predicted: Float64[Tensor, "rows 3"], by_images: bool
) -> Iterator[tuple[MeasuredPoses, Cause]]:
    """Yield positions in other units, mirrored positions and orientations, and inverted poses.

    Args:
        measured: the measured poses.
        predicted: predicted positions, up to a rigid transform [m].
        by_images: whether the poses are of boards in images, whose scale is the scale of the board.
    """
    advice = "check the order and the directions of the sensor's axes"
    if by_images:
        factor = position_spread(predicted) / position_spread(measured.position)
        clause = f"the squares of the board are {factor:.4g} times as large as stated"
        cause = Cause("position_unit", clause, "measure the board and correct its file", 1.0)
        yield replace(measured, position=measured.position * factor), cause
        advice = "use the images as the camera's sensor takes them, not flipped"
    else:
        for factor, are, named in MISNAMED_UNITS:
            clause = f"x, y and z are in {are} but labelled as {named}"
            yield (
                replace(measured, position=measured.position * factor),
                Cause("position_unit", clause, "correct the unit in the column names", 1.0, amount=factor),
            )
    positions = replace(measured, position=measured.position @ _MIRROR)
    what = "the measured positions are"
    if bool(measured.has_rotation.any()):
        rotations = replace(measured, rotation=_MIRROR @ measured.rotation @ _MIRROR)
        yield rotations, Cause("handedness", _MIRRORED.format("the measured orientations are"), advice, 1.0)
        both = replace(positions, rotation=rotations.rotation)
        yield both, Cause("handedness", _MIRRORED.format("the measured poses are"), advice, 1.0)
        turned_back = measured.rotation.mT
        place = -(turned_back @ measured.position[..., None])[..., 0]
        clause = "the measured poses are those of the sensor in the target's frame (inverse poses)"
        inverse = replace(measured, position=place, rotation=turned_back)
        forward = "write the target's pose in the sensor's frame; for a camera, check --fixed-camera"
        yield inverse, Cause("rotation", clause, forward, 1.0)
        what += ", other than the orientations,"
    yield positions, Cause("handedness", _MIRRORED.format(what), advice, 1.0)


def position_spread(position: Float64[Tensor, "rows 3"]) -> float:
    """Compute the RMS distance from the mean position [m]."""
    return float((position - position.mean(0)).square().sum(-1).mean().sqrt())


def other_conventions(
    rotation: Float64[Tensor, "rows 3 3"],
) -> Iterator[tuple[Float64[Tensor, "rows 3 3"], str, float]]:
    """Yield the measured orientations under the assumption that they were written in another convention.

    Returns:
        The rotations, what is wrong with the file's rotations, and the complexity of the assumption; see
            `Cause.complexity`.
    """
    from scipy.spatial.transform import Rotation  # imported here, because every calibration imports this file

    read = Rotation.from_matrix(rotation.numpy())
    wxyz = Rotation.from_quat(np.roll(read.as_quat(), -1, 1))
    inverse = "the orientations are inverse (a conjugate quaternion, or a transposed matrix)"
    scalar = "the quaternions are in the order qw, qx, qy, qz (the scalar part first)"
    yield from (
        (_matrices(read.inv()), inverse, 1.0),
        (_matrices(wxyz), scalar, 1.0),
        (_matrices(wxyz.inv()), f"{scalar} and are conjugate", 1.25),
    )
    angles = read.as_euler(_READ_ORDER)
    for columns in (RPY, RPY[::-1]):
        of_columns = [RPY.index(name) for name in columns]
        turned, vector = angles[:, of_columns], _as_rotation_vector(angles)[:, of_columns]
        clause = f"{', '.join(columns)} contain the x, y and z of a rotation vector (axis times angle)"
        yield _matrices(Rotation.from_rotvec(vector)), clause, 1.0
        for order in _EULER_ORDERS:
            product = " · ".join(f"Rot{axis}({name})" for axis, name in zip(order, columns, strict=True))
            clause = f"roll, pitch and yaw are angles of another order, the Euler angles of {product}"
            yield _matrices(Rotation.from_euler(order, turned)), clause, 1.0
            clause += " in radians but labelled as degrees"
            yield _matrices(Rotation.from_euler(order, np.rad2deg(turned))), clause, 1.0
    for signs in itertools.product((1, -1), repeat=3):
        names = ", ".join(("-" if sign < 0 else "") + name for sign, name in zip(signs, RPY, strict=True))
        clause = f"signs of angles are reversed: {names} were meant"
        yield _matrices(Rotation.from_euler(_READ_ORDER, angles * signs)), clause, 1.5


def _as_rotation_vector(angles: Float64[np.ndarray, "rows 3"]) -> Float64[np.ndarray, "rows 3"]:
    """Return roll, pitch and yaw in whichever of the two equivalent forms is the shorter vector.

    A rotation vector that was read as angles may have a second component beyond 90 deg; the angles computed from the
    matrix are then the other form.
    """
    roll, pitch, yaw = angles.T
    half = np.pi * np.stack([-np.sign(roll), np.sign(pitch), -np.sign(yaw)], 1)
    other = np.stack([roll, -pitch, yaw], 1) + half
    longer = np.linalg.norm(angles, axis=1) > np.linalg.norm(other, axis=1)
    return np.where(longer[:, None], other, angles)


def _matrices(rotation: "Rotation") -> Float64[Tensor, "rows 3 3"]:
    return torch.from_numpy(rotation.as_matrix())

"""Find the base of several arms, or the shared frame, that was moved, from poses before and now."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from scipy.stats import f as fisher
from torch import Tensor

from pisigma.calibration.frames.shared_objects import ArmPosterior, is_determined
from pisigma.files.errors import IdentificationError, Phrase
from pisigma.model.frame_model import FittedFrames
from pisigma.robot.se3 import invert, rotation_from_vector, rotation_vector, skew, transform_from_xyz_zyx

_FALSE_ALARMS = 1e-3
"""Probability that arms and frames that did not move are reported to have moved."""
_CERTAIN = 5.0
"""Difference of log likelihoods above which one moved body is a better explanation than another."""


@dataclass(frozen=True, eq=False)
class RemeasuredArm:
    """An arm as calibrated before and as measured now.

    Attributes:
        posterior: posterior of its model.
        T_first_base: its base relative to the base of the first arm, when its model was made.
        current_frames: its current bases, fitted with the arm of the model.
    """

    posterior: ArmPosterior
    T_first_base: Float64[Tensor, "4 4"]
    current_frames: FittedFrames

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames in which the base was determined both before and now."""
        return tuple(
            name
            for name in self.current_frames.fit.solved.geometry.bases
            if ("frame", name) in self.posterior.shared_objects and is_determined(self._noise(name))
        )

    def _rows(self, frame: str) -> list[int]:
        """Return the indices of the base in a frame among the fitted coordinates."""
        parameters = self.current_frames.fit.parameters
        return [k for k, one in enumerate(parameters) if one.group == "base" and one.owner == frame]

    def _noise(self, frame: str) -> Float64[Tensor, "6 directions"]:
        """Return a root of the covariance of the current base due to the noise of the rows."""
        fit = self.current_frames.fit
        return fit.solved.covariance_root[[fit.frame_indices[k] for k in self._rows(frame)]]

    @property
    def degrees_of_freedom(self) -> float:
        """Number of values from which the current noise was estimated, minus the parameters fitted to them."""
        return sum(
            one.values - one.effective_parameters for one in self.current_frames.fit.solved.result().noise
        )

    def displacement(self, frame: str) -> tuple[Float64[Tensor, " 6"], Float64[Tensor, "6 directions"]]:
        """Return the displacement of the base relative to a frame, with a root of its covariance.

        Returns:
            Translation [m] and rotation vector [rad] of the rigid motion that moves the previous base onto the current
            base, in the coordinates of the previous base of the first arm; and their derivatives along the directions
            of the root of the model, followed by those of the current noise.
        """
        before = self.posterior.values[list(self.posterior.base_indices(frame))]
        now = torch.from_numpy(self.current_frames.fit.solved.geometry.bases[frame].copy())
        T_first_frame = self.T_first_base @ invert(transform_from_xyz_zyx(before))

        def motion(bases: Tensor) -> Tensor:
            T_now, T_before = transform_from_xyz_zyx(bases)
            D = T_first_frame @ T_now @ invert(T_before) @ invert(T_first_frame)
            return torch.cat([D[:3, 3], rotation_vector(D[:3, :3])])

        both = torch.stack([now, before])
        J = torch.func.jacrev(motion)(both)
        arm = J[:, 0] @ self.current_frames.arm_covariance_root[self._rows(frame)]
        arm = arm + J[:, 1] @ self.posterior.covariance_root[list(self.posterior.base_indices(frame))]
        noise = J[:, 0] @ self._noise(frame)
        return motion(both), torch.cat([arm, noise], 1)


@dataclass(frozen=True, eq=False)
class MovedBody:
    """An arm, a frame, or the zero of the first joint of a torso that may have moved.

    Attributes:
        kind: "arm" (its base, or the one base of the arms of a torso), "frame" or "joint" (its zero).
        name: name of the arm (the first one of a torso), frame or joint.
        shift: shift of the origin along the axes of the first arm's base [m].
        rotation: rotation about these axes [rad].
        covariance: covariance of both [m and rad].
        log_likelihood: log likelihood if only this body moved, relative to no motion.
    """

    kind: str
    name: str
    shift: Float64[Tensor, " 3"]
    rotation: Float64[Tensor, " 3"]
    covariance: Float64[Tensor, "6 6"]
    log_likelihood: float


@dataclass(frozen=True, eq=False)
class MovedBases:
    """Bodies that moved between the calibration of arms and new rows.

    Attributes:
        p_value: probability of differences this large if nothing moved.
        bodies: arms, frames and joints, best explanation first, each as if only it had moved.
        is_one_body: whether the motion of the first body explains the differences; otherwise more than one body moved.
        explaining_joint: the joint whose zero alone explains the differences as well as the motion of a body; None if
            there is none.
    """

    p_value: float
    bodies: tuple[MovedBody, ...]
    is_one_body: bool
    explaining_joint: MovedBody | None = None

    @cached_property
    def likely_bodies(self) -> tuple[MovedBody, ...]:
        """The body whose motion explains the differences best; several if these cannot be distinguished, or none."""
        if self.p_value >= _FALSE_ALARMS:
            return ()
        if self.explaining_joint is not None:
            return (self.explaining_joint,)
        best = self.bodies[0].log_likelihood
        return tuple(one for one in self.bodies if one.log_likelihood > best - _CERTAIN)


def find_moved_bases(arms: Sequence[RemeasuredArm]) -> MovedBases:
    """Find the arm's base or the frame that has been moved since the arms were calibrated.

    The current bases are fitted with the arms as calibrated. Errors of an arm shift its base equally before and now, so
    they cancel, which the covariance takes into account. Under every hypothesis, one body moved by an unknown rigid
    motion; the arms of a torso have one base. A new zero of the first joint of a torso is a rotation of this base about
    the axis of the joint, and is named if the other five directions of a rigid motion explain no more. The noise is
    estimated from few rows, so differences are compared with an F distribution with the degrees of freedom of this
    estimate.

    Args:
        arms: the arms, each now measured in one or more of its previous frames.

    Raises:
        IdentificationError: the base of an arm is not determined in a previous frame with a name.
    """
    owners, motions, roots = [], [], []
    for number, arm in enumerate(arms):
        if not arm.frames:
            raise IdentificationError(
                expected=f"rows of arm '{arm.posterior.name}' that determine its base in a named frame of its "
                "calibration",
                value=Phrase(", ".join(arm.current_frames.fit.solved.geometry.bases)),
                remedy="use the same name in the column 'frame', and measure 6 different poses or more",
            )
        for frame in arm.frames:
            motion, root = arm.displacement(frame)
            owners.append((number, frame))
            motions.append(motion)
            roots.append(root)
    covariance = _joint_covariance(owners, roots)
    y = torch.cat(motions)
    L = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(L, y[:, None], upper=False)[:, 0]
    freedom = min(arm.degrees_of_freedom for arm in arms)
    square = float(white.square().sum())
    probability = float(fisher.sf(square / len(y), len(y), freedom))
    torso = {
        name: arm.posterior.torso_joints[0]
        for arm in arms
        for name in (arm.posterior.name,)
        if arm.posterior.torso_joints
    }
    first = {joint: name for name, joint in reversed(torso.items())}
    bodies = [
        _if_moved(arms, owners, body, L, white)
        for body in dict.fromkeys(
            [("arm", first.get(torso.get(arm.posterior.name, ""), arm.posterior.name)) for arm in arms]
            + [("frame", frame) for _, frame in owners]
            + [("joint", joint) for joint in first]
        )
    ]
    bodies.sort(key=lambda one: -one.log_likelihood)
    rest, count = square - 2 * bodies[0].log_likelihood, len(y) - 6
    is_one = count == 0 or float(fisher.sf(rest / count, count, freedom)) >= _FALSE_ALARMS
    gains = [
        (2 * (bodies[0].log_likelihood - one.log_likelihood) / 5, one)
        for one in bodies
        if one.kind == "joint"
    ]
    joints = [one for gain, one in gains if is_one and float(fisher.sf(gain, 5, freedom)) >= _FALSE_ALARMS]
    return MovedBases(probability, tuple(bodies), is_one, joints[0] if joints else None)


def _joint_covariance(
    owners: Sequence[tuple[int, str]], roots: Sequence[Float64[Tensor, "6 directions"]]
) -> Float64[Tensor, "motions motions"]:
    """Return the covariance of all motions; motions of the same arm have directions in common."""
    covariance = torch.zeros(6 * len(owners), 6 * len(owners), dtype=torch.float64)
    for i, (one, _) in enumerate(owners):
        for k, (other, _) in enumerate(owners):
            if one == other:
                covariance[6 * i : 6 * i + 6, 6 * k : 6 * k + 6] = roots[i] @ roots[k].mT
    return covariance


def _if_moved(
    arms: Sequence[RemeasuredArm],
    owners: Sequence[tuple[int, str]],
    body: tuple[str, str],
    L: Float64[Tensor, "motions motions"],
    white: Float64[Tensor, " motions"],
) -> MovedBody:
    """Return the motion of a body if only this body moved; the arms see the opposite motion of a frame."""
    kind, name = body
    moving = [arms[number].posterior for number, _ in owners]
    same = next(
        (
            arm.torso_joints[0]
            for arm in moving
            if arm.torso_joints and name in (arm.name, arm.torso_joints[0])
        ),
        "",
    )
    signs = [
        (-1.0 if frame == name else 0.0)
        if kind == "frame"
        else float(arm.name == name or same in arm.torso_joints[:1])
        for arm, (_, frame) in zip(moving, owners, strict=True)
    ]
    eye = torch.eye(6, dtype=torch.float64)
    origin = _origin(arms, owners, body)
    along = eye
    if kind == "joint":
        axis = next(arm.T_first_base[:3, 2] for arm in arms if name in arm.posterior.torso_joints)
        along = torch.cat([torch.linalg.cross(origin, axis), axis])[:, None]
    G = torch.linalg.solve_triangular(L, torch.cat([sign * along for sign in signs]), upper=False)
    Q, R = torch.linalg.qr(G)
    explained = Q.mT @ white
    inverse = along @ torch.linalg.inv(R)
    motion = inverse @ explained
    turn = rotation_from_vector(motion[3:])
    J = eye.clone()
    J[:3, 3:] = -skew(origin)
    moved = (
        turn @ motion[:3] if kind == "frame" else motion[:3]
    )  # the inverse of the motion that the arms see
    shift = turn @ origin + moved - origin
    covariance = J @ inverse @ inverse.mT @ J.mT
    return MovedBody(kind, name, shift, motion[3:], covariance, float(explained.square().sum()) / 2)


def _origin(
    arms: Sequence[RemeasuredArm], owners: Sequence[tuple[int, str]], body: tuple[str, str]
) -> Float64[Tensor, " 3"]:
    """Return the origin of an arm's base or of a frame in the base of the first arm [m]."""
    kind, name = body
    if kind != "frame":
        arm = next(arm for arm in arms if name in (arm.posterior.name, *arm.posterior.torso_joints))
        return arm.T_first_base[:3, 3]
    arm = next(arms[number] for number, frame in owners if frame == name)
    before = arm.posterior.values[list(arm.posterior.base_indices(name))]
    return (arm.T_first_base @ invert(transform_from_xyz_zyx(before)))[:3, 3]

"""Bases of several arms relative to each other, from what the fits of the arms have in common."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from scipy.stats import chi2
from torch import Tensor

from pisigma.calibration.frames.initial_bases import (
    COLLINEAR,
    fitted_pose,
    initial_bases,
    shared_object_in_base,
)
from pisigma.calibration.frames.shared_joints import (
    arms_sharing_most_joints,
    axis_difference,
    shared_joint_count,
    with_common_joints,
    with_values,
)
from pisigma.calibration.frames.shared_objects import (
    JOINT,
    TOUCH,
    ArmPosterior,
    Postures,
    SharedObject,
    find_shared_objects,
)
from pisigma.calibration.frames.touch_equations import (
    Tip,
    TipPositions,
    check_touches,
    initial_tips,
    tip_positions,
    touch_equations,
    touch_sigmas,
)
from pisigma.estimation.covariance_root import ConditionedUnknowns, condition_on_equalities
from pisigma.files.errors import IdentificationError, Phrase
from pisigma.measurement.conditions import JointState
from pisigma.robot.frame_fits import moved_frame
from pisigma.robot.se3 import invert, pose_error, skew

_CLOSURE = 1e-9
"""Standard deviation [m or rad] with which frames and points that two arms share are equated, for rounding errors."""
_FALSE_ALARMS = 1e-4
"""Probability that arms without faults are reported to disagree."""
MAX_ITERATIONS, _CONVERGENCE_TOLERANCE = 20, 1e-12
_UNDETERMINED = 1e-5
"""Ratio of the smallest to the largest singular value of equations that do not determine all bases and tips."""


@dataclass(frozen=True)
class Disagreement:
    """A shared object whose poses or positions differ between arms.

    Attributes:
        shared: the object.
        distance: largest distance between its positions according to two arms, with the fitted bases [m].
        p_value: probability that arms without faults differ at least as much at this object, given the other
            objects.
    """

    shared: SharedObject
    distance: float
    p_value: float


@dataclass(frozen=True, eq=False)
class ArmBases:
    """Bases of several arms, relative to the base of the first arm.

    Attributes:
        individual_posteriors: posteriors of the individually calibrated arms.
        shared: what the arms have in common.
        T_first_base: pose of every arm's base in the base of the first arm.
        tips: positions of touching tips that no target of the rows is, on the last row of an arm [m].
        conditioned: the joint posterior; its x are shifts of the bases of all other arms along, and rotations about,
            the axes of the first arm's base [m and rad], followed by `tips`; its z the directions of the roots of all
            arms.
        object_of_equation: per equation, the index of the shared object.
        largest_distances: per shared object, the largest distance between its positions by two arms [m].
        equation_system: derivatives of the equations with respect to z and x, their misclosure at z = 0, and their
            standard deviations.
    """

    individual_posteriors: tuple[ArmPosterior, ...]
    shared: tuple[SharedObject, ...]
    T_first_base: Float64[Tensor, "arms 4 4"]
    tips: dict[Tip, Float64[Tensor, " 3"]]
    conditioned: ConditionedUnknowns
    object_of_equation: tuple[int, ...]
    largest_distances: tuple[float, ...]
    equation_system: tuple[Tensor, Tensor, Tensor, Tensor]

    @property
    def covariance_root(self) -> Float64[Tensor, "arms 6 directions"]:
        """Root of the covariance of the bases, as shifts along and rotations about the axes of the first base."""
        found = self.conditioned.x_root[: 6 * (len(self.individual_posteriors) - 1)]
        return torch.cat([found.new_zeros(6, found.shape[1]), found]).view(
            len(self.individual_posteriors), 6, -1
        )

    def relative(self, first: int, second: int) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "6 6"]]:
        """Return the base of an arm relative to that of another arm, with its covariance.

        Arms of one torso have one base, see `updated_arms`.

        Args:
            first: index of the arm in whose base the pose is expressed.
            second: index of the other arm.

        Returns:
            The pose, and the covariance of its shift along and rotation about the axes of the base of arm `first` [m
            and rad].
        """
        first, second = (self.reference_arm(number) for number in (first, second))
        T = invert(self.T_first_base[first]) @ self.T_first_base[second]
        away = self.T_first_base[second, :3, 3] - self.T_first_base[first, :3, 3]
        moved = self.covariance_root[second] - self.covariance_root[first]
        # A rotation of the first base also shifts the second base relative to it.
        moved[:3] += torch.linalg.cross(
            away[:, None].expand(3, moved.shape[1]), self.covariance_root[first, 3:], dim=0
        )
        turned = (self.T_first_base[first, :3, :3].mT @ moved.view(2, 3, -1)).flatten(0, 1)
        return T, turned @ turned.mT

    def tool_to_tool_sigma(self, first: int, second: int, postures: tuple[Postures, ...]) -> float:
        """Return the RMS standard deviation of the vector from the tool of one arm to that of another [m].

        Unlike the uncertainty of the bases, it does not depend on errors that a base absorbs, such as the zero of
        joint 1.

        Args:
            first: index of an arm.
            second: index of the other arm.
            postures: postures of every arm; the n-th postures of both arms form a pair, in which the shared joints of
                a torso have the values of the first arm.
        """
        count = min(len(postures[number].q_corrected) for number in (first, second))
        one, other = (postures[number][torch.arange(count)] for number in (first, second))
        shared = self.joints_in_common(first, second)
        q, moved = other.state.q.clone(), other.q_corrected.clone()
        q[:, :shared], moved[:, :shared] = one.state.q[:, :shared], one.q_corrected[:, :shared]
        other = Postures(JointState(q, other.state.conditions), moved)
        apart = self._tool_root(second, other) - self._tool_root(first, one)
        return float(apart.square().sum((1, 2)).mean().sqrt())

    def _tool_root(self, number: int, postures: Postures) -> Float64[Tensor, "postures 3 directions"]:
        """Return a root of the covariance of the positions of a tool in the base of the first arm."""
        arm = self.individual_posteriors[number]
        sizes = [one.covariance_root.shape[1] for one in self.individual_posteriors]
        T, columns = arm.tool_poses_in_base(postures)
        in_base = columns @ (arm.covariance_root @ torch.split(self.conditioned.z_root, sizes)[number])
        R = self.T_first_base[number, :3, :3]
        away = (R @ T[:, :3, 3, None])[..., 0]
        shift, turn = self.covariance_root[number, :3], self.covariance_root[number, 3:]
        return R @ in_base + shift - skew(away) @ turn

    def joints_in_common(self, first: int, second: int) -> int:
        """Return the number of joints of a torso that two arms share."""
        return shared_joint_count(self.individual_posteriors[first], self.individual_posteriors[second])

    def reference_arm(self, arm_index: int) -> int:
        """Return the index of the arm whose base and shared joints an arm has."""
        while (before := arms_sharing_most_joints(self.individual_posteriors)[arm_index][0]) != arm_index:
            arm_index = before
        return arm_index

    @cached_property
    def updated_arms(self) -> tuple[ArmPosterior, ...]:
        """Posteriors of the arms given all equations; arms of a torso share the base and the rows of common joints."""
        sizes = [arm.covariance_root.shape[1] for arm in self.individual_posteriors]
        parts = zip(
            torch.split(self.conditioned.z, sizes),
            torch.split(self.conditioned.z_root, sizes),
            arms_sharing_most_joints(self.individual_posteriors),
            strict=True,
        )
        arms: list[ArmPosterior] = []
        for number, (z, z_root, (before, count)) in enumerate(parts):
            arm, own = (
                self.individual_posteriors[number],
                len(self.individual_posteriors[number].space.parameters),
            )
            arm = with_values(arm, arm.values + arm.covariance_root[:own] @ z, arm.covariance_root @ z_root)
            if count:
                root = self.reference_arm(number)
                T, steps = self.T_first_base, self.covariance_root
                arm = with_common_joints(
                    arm, arms[before], (T[number], T[root]), (steps[number], steps[root]), count
                )
            arms.append(arm)
        return tuple(arms)

    @property
    def p_value(self) -> float:
        """Probability of a larger misfit between arms without faults; 1 if no object is measured twice."""
        found = self.conditioned
        return float(chi2.sf(found.misfit, found.degrees_of_freedom)) if found.degrees_of_freedom else 1.0

    @cached_property
    def disagreements(self) -> tuple[Disagreement, ...]:
        """Shared objects on whose location the arms disagree, least probable first; empty if they agree."""
        if self.p_value >= _FALSE_ALARMS:
            return ()
        found = []
        B, G, r, closure = self.equation_system
        number = torch.tensor(self.object_of_equation)
        for index, shared in enumerate(self.shared):
            others = number != index
            if int(torch.linalg.matrix_rank(G[others], rtol=COLLINEAR)) < G.shape[1]:
                drop, freedom = self.conditioned.misfit, self.conditioned.degrees_of_freedom
            else:
                left = condition_on_equalities(B[others], G[others], r[others], closure[others])
                drop = self.conditioned.misfit - left.misfit
                freedom = self.conditioned.degrees_of_freedom - left.degrees_of_freedom
            probability = float(chi2.sf(drop, freedom))
            if probability < _FALSE_ALARMS / len(self.shared):
                found.append(Disagreement(shared, self.largest_distances[index], probability))
        return tuple(sorted(found, key=lambda one: (one.p_value, -one.distance)))


def fit_arm_bases(arms: Sequence[ArmPosterior]) -> ArmBases:
    """Find the base of every arm in that of the first one, by equating what the arms have in common.

    The arms were calibrated independently of each other. Their joint posterior is the product of their individual
    posteriors, given that every shared frame is one frame, every shared point is one point, every shared joint of a
    torso has one axis, and the tips of two arms are at one point if they touch, except for the stated noise of the
    touch; bases and unknown tips have no prior.
    The individual posteriors summarise the rows as normal distributions. The result therefore equals that of one
    least-squares fit to all rows with the noise and prior scales of the individual fits, to first order in the errors
    of the arms, and exactly if positions are linear in the parameters. The equations are linearised repeatedly until
    they close.

    With one shared frame, the equations determine only the bases. With more, the arms also improve each other's
    parameters.

    Args:
        arms: two or more arms.

    Raises:
        IdentificationError: the shared frames, points and touches do not determine the bases of all arms, or a touch is
            not one row of each of two arms.
    """
    check_touches(arms)
    shared = find_shared_objects(arms)
    touches = [one for one in shared if one.kind == TOUCH]
    others, tips = shared[: len(shared) - len(touches)], initial_tips(arms)
    T = torch.stack(list(initial_bases(arms, shared, tip_positions(arms, tips))))
    z = [torch.zeros(arm.covariance_root.shape[1], dtype=torch.float64) for arm in arms]
    closed = [_CLOSURE] * sum(_count(arms, one) for one in others)
    closure = torch.tensor([*closed, *(sigma for sigma in touch_sigmas(arms, touches) for _ in range(3))]).to(
        T
    )
    for _ in range(MAX_ITERATIONS):
        B, G, missed = _linearised(arms, others, T, z)
        more = touch_equations(arms, touches, T, tips, z)
        G = torch.nn.functional.pad(G, (0, 3 * len(tips)))
        B, G, missed = (torch.cat(pair) for pair in zip((B, G, missed), more, strict=True))
        _check_rank(arms, shared, G)
        r = B @ torch.cat(z) - missed
        found = condition_on_equalities(B, G, r, closure)
        step, moved = found.x[: 6 * (len(arms) - 1)].view(-1, 6), found.x[6 * (len(arms) - 1) :].view(-1, 3)
        T = torch.cat([T[:1], moved_frame(T[1:], step)])
        tips = {name: tip + one for (name, tip), one in zip(tips.items(), moved, strict=True)}
        z = list(torch.split(found.z, [len(one) for one in z]))
        if float(found.x.abs().max()) < _CONVERGENCE_TOLERANCE:
            break
    numbers = tuple(number for number, one in enumerate(shared) for _ in range(_count(arms, one)))
    there = tip_positions(arms, tips)
    distances = tuple(_distance(arms, one, T, there) for one in shared)
    return ArmBases(tuple(arms), shared, T, tips, found, numbers, distances, (B, G, r, closure))


def _check_rank(arms: Sequence[ArmPosterior], shared: Sequence[SharedObject], G: Tensor) -> None:
    """Refuse equations that do not determine all bases and tips.

    Raises:
        IdentificationError: G does not have full column rank.
    """
    if int(torch.linalg.matrix_rank(G, rtol=_UNDETERMINED)) < G.shape[1]:
        raise IdentificationError(
            expected=f"shared frames, points and touches that determine the bases of {', '.join(a.name for a in arms)}",
            value=Phrase(f"{len(shared)} that leave a direction open"),
            remedy="touch at points that are not on one line, with different orientations of both arms if their tips "
            "are unknown",
        )


def _count(arms: Sequence[ArmPosterior], one: SharedObject) -> int:
    """Return the number of equations of a shared object: one per parameter and further arm."""
    if one.kind == TOUCH:
        return 3
    if one.kind == JOINT:
        return (4 if _is_revolute(arms, one) else 2) * (len(one.arms) - 1)
    return len(arms[one.arms[0]].shared_objects[one.key][1]) * (len(one.arms) - 1)


def _is_revolute(arms: Sequence[ArmPosterior], one: SharedObject) -> bool:
    """Return whether a shared joint is revolute."""
    rows = arms[one.arms[0]].space.robot.rows
    return next(row.type == "revolute" for row in rows if row.name == one.name)


def _used(arms: Sequence[ArmPosterior], shared: Sequence[SharedObject]) -> list[list[int]]:
    """Return the indices of the parameters of every arm on which the equations depend."""
    used: list[set[int]] = [set() for _ in arms]
    for one in shared:
        for number in one.arms:
            frame, rows = arms[number].shared_objects[one.key]
            used[number] |= {*rows, *(() if one.kind == JOINT else arms[number].base_indices(frame))}
    return [sorted(rows) for rows in used]


def _linearised(
    arms: Sequence[ArmPosterior],
    shared: Sequence[SharedObject],
    T: Float64[Tensor, "arms 4 4"],
    z: Sequence[Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return derivatives of the equations of frames and points with respect to z and bases, and their values."""
    used = _used(arms, shared)
    roots = [arm.covariance_root[rows] for arm, rows in zip(arms, used, strict=True)]
    now = [arm.values[rows] + R @ one for arm, rows, R, one in zip(arms, used, roots, z, strict=True)]
    sizes = [len(rows) for rows in used]
    places = [{row: place for place, row in enumerate(rows)} for rows in used]

    def equations(unknowns: Tensor) -> Tensor:
        steps = unknowns[sum(sizes) :].view(-1, 6)
        bases = torch.cat([T[:1], moved_frame(T[1:], steps)])
        parts = torch.split(unknowns[: sum(sizes)], sizes)
        return torch.cat([unknowns[:0], *_equations(arms, shared, bases, parts, places)])

    at = torch.cat([*now, torch.zeros(6 * (len(arms) - 1), dtype=torch.float64)])
    J = torch.func.jacrev(equations)(at)
    J_own, G = J[:, : sum(sizes)], J[:, sum(sizes) :]
    B = torch.cat([part @ R for part, R in zip(torch.split(J_own, sizes, 1), roots, strict=True)], 1)
    return B, G, equations(at)


def _equations(
    arms: Sequence[ArmPosterior],
    shared: Sequence[SharedObject],
    bases: Tensor,
    parts: Sequence[Tensor],
    places: Sequence[dict[int, int]],
) -> Iterator[Tensor]:
    """Yield the differences between the first arm of every shared object and each of its other arms."""
    for one in shared:
        seen = []
        for number in one.arms:

            def values(rows: Sequence[int], number: int = number) -> Tensor:
                return parts[number][[places[number][row] for row in rows]]

            pose, more = shared_object_in_base(arms[number], one.key, values)
            seen.append((bases[number] @ pose, more))
        for pose, more in seen[1:]:
            if one.kind == JOINT:
                yield axis_difference(seen[0][0], pose, _is_revolute(arms, one))
                continue
            error = pose_error(pose, seen[0][0])
            yield torch.cat([error if one.kind == "frame" else error[:3], more - seen[0][1]])


def _distance(
    arms: Sequence[ArmPosterior],
    one: SharedObject,
    T: Float64[Tensor, "arms 4 4"],
    tips: Sequence[TipPositions | None],
) -> float:
    """Return the largest distance between the positions of a shared object by the fits of two arms [m]."""
    poses = torch.stack([T[number] @ fitted_pose(arms, number, one, tips) for number in one.arms])
    if one.kind == JOINT:
        apart = [axis_difference(poses[0], pose, True)[2:].norm() for pose in poses]
        return float(max(apart)) if _is_revolute(arms, one) else 0.0
    return float(torch.cdist(poses[:, :3, 3], poses[:, :3, 3]).max())

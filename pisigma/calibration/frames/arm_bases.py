"""Bases of several arms relative to each other, from what the fits of the arms have in common."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from scipy.stats import chi2
from torch import Tensor

from pisigma.calibration.frames.shared_objects import ArmPosterior, SharedObject, find_shared_objects
from pisigma.estimation.covariance_root import ConditionedUnknowns, condition_on_equalities
from pisigma.files.errors import IdentificationError, Phrase
from pisigma.robot.frame_fits import MeasuredPoses, best_base
from pisigma.robot.se3 import (
    invert,
    pose_error,
    rotation_from_vector,
    transform,
    transform_from_xyzrpy,
)

_CLOSURE = 1e-9
"""Standard deviation [m or rad] with which frames and points that two arms share are equated, for rounding errors."""
_FALSE_ALARMS = 1e-4
"""Probability that arms without faults are reported to disagree."""
MAX_ITERATIONS, _CONVERGENCE_TOLERANCE = 20, 1e-12
_MIN_POINTS = 3
_COLLINEAR = 1e-3
"""Ratio of the second to the first singular value of points below which they lie on a line and determine no
rotation."""


@dataclass(frozen=True)
class Disagreement:
    """A shared object whose poses or positions differ between arms.

    Attributes:
        shared: the object.
        distance: largest distance between its positions according to two arms, with the fitted bases [m].
        probability: probability that arms without faults differ at least as much at this object, given the other
            objects.
    """

    shared: SharedObject
    distance: float
    probability: float


@dataclass(frozen=True, eq=False)
class ArmBases:
    """Bases of several arms, relative to the base of the first arm.

    Attributes:
        arms: posteriors of the individually calibrated arms.
        shared: what the arms have in common.
        T_first_base: pose of every arm's base in the base of the first arm.
        conditioned: the joint posterior; its x are shifts of the bases of all other arms along, and rotations about,
            the axes of the first arm's base [m and rad], its z the directions of the roots of all arms.
        equations: per equation, the index of the shared object.
        distances: per shared object, the largest distance between its positions by two arms [m].
        system: derivatives of the equations with respect to z and x, and their misclosure at z = 0.
    """

    arms: tuple[ArmPosterior, ...]
    shared: tuple[SharedObject, ...]
    T_first_base: Float64[Tensor, "arms 4 4"]
    conditioned: ConditionedUnknowns
    equations: tuple[int, ...]
    distances: tuple[float, ...]
    system: tuple[Tensor, Tensor, Tensor]

    @property
    def covariance_root(self) -> Float64[Tensor, "arms 6 directions"]:
        """Root of the covariance of the bases, as shifts along and rotations about the axes of the first base."""
        found = self.conditioned.x_root
        return torch.cat([found.new_zeros(6, found.shape[1]), found]).view(len(self.arms), 6, -1)

    def relative(self, first: int, second: int) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "6 6"]]:
        """Return the base of an arm relative to that of another arm, with its covariance.

        Args:
            first: index of the arm in whose base the pose is expressed.
            second: index of the other arm.

        Returns:
            The pose, and the covariance of its shift along and rotation about the axes of the base of arm `first` [m
            and rad].
        """
        T = invert(self.T_first_base[first]) @ self.T_first_base[second]
        away = self.T_first_base[second, :3, 3] - self.T_first_base[first, :3, 3]
        moved = self.covariance_root[second] - self.covariance_root[first]
        # A rotation of the first base also shifts the second base relative to it.
        moved[:3] += torch.linalg.cross(
            away[:, None].expand(3, moved.shape[1]), self.covariance_root[first, 3:], dim=0
        )
        turned = (self.T_first_base[first, :3, :3].mT @ moved.view(2, 3, -1)).flatten(0, 1)
        return T, turned @ turned.mT

    @property
    def probability(self) -> float:
        """Probability of a larger misfit between arms without faults; 1 if no object is measured twice."""
        found = self.conditioned
        return float(chi2.sf(found.misfit, found.redundancy)) if found.redundancy else 1.0

    @cached_property
    def disagreements(self) -> tuple[Disagreement, ...]:
        """Shared objects on whose location the arms disagree, least probable first; empty if they agree."""
        if self.probability >= _FALSE_ALARMS:
            return ()
        found = []
        B, G, r = self.system
        number = torch.tensor(self.equations)
        for index, shared in enumerate(self.shared):
            others = number != index
            if int(torch.linalg.matrix_rank(G[others], rtol=_COLLINEAR)) < G.shape[1]:
                drop, freedom = self.conditioned.misfit, self.conditioned.redundancy
            else:
                left = condition_on_equalities(B[others], G[others], r[others], closures(others.sum()))
                drop = self.conditioned.misfit - left.misfit
                freedom = self.conditioned.redundancy - left.redundancy
            probability = float(chi2.sf(drop, freedom))
            if probability < _FALSE_ALARMS / len(self.shared):
                found.append(Disagreement(shared, self.distances[index], probability))
        return tuple(sorted(found, key=lambda one: (one.probability, -one.distance)))


def closures(count: int | Tensor) -> Float64[Tensor, " equations"]:
    """Return the standard deviations of the equations."""
    return torch.full((int(count),), _CLOSURE, dtype=torch.float64)


def fit_arm_bases(arms: Sequence[ArmPosterior]) -> ArmBases:
    """Find the base of every arm in that of the first one, by equating what the arms have in common.

    The arms were calibrated independently of each other. Their joint posterior is the product of their individual
    posteriors, given that every shared frame is one frame and every shared point is one point; the bases have no prior.
    The individual posteriors summarise the rows as normal distributions. The result therefore equals that of one
    least-squares fit to all rows with the noise and prior scales of the individual fits, to first order in the errors
    of the arms, and exactly if positions are linear in the parameters. The equations are linearised repeatedly until
    they close.

    With one shared frame, the equations determine only the bases. With more, the arms also improve each other's
    parameters.

    Args:
        arms: two or more arms.

    Raises:
        IdentificationError: the shared frames and points do not connect all arms.
    """
    shared = find_shared_objects(arms)
    T = torch.stack(list(_start(arms, shared)))
    z = [torch.zeros(arm.root.shape[1], dtype=torch.float64) for arm in arms]
    for _ in range(MAX_ITERATIONS):
        B, G, closed = _linearised(arms, shared, T, z)
        r = B @ torch.cat(z) - closed
        found = condition_on_equalities(B, G, r, closures(len(r)))
        step = found.x.view(-1, 6)
        T = torch.cat([T[:1], _moved(T[1:], step)])
        z = list(torch.split(found.z, [len(one) for one in z]))
        if float(step.abs().max()) < _CONVERGENCE_TOLERANCE:
            break
    numbers = tuple(number for number, one in enumerate(shared) for _ in range(_count(arms, one)))
    distances = tuple(_distance(arms, one, T) for one in shared)
    return ArmBases(tuple(arms), shared, T, found, numbers, distances, (B, G, r))


def _moved(T: Float64[Tensor, "*batch 4 4"], step: Float64[Tensor, "*batch 6"]) -> Tensor:
    """Return poses that are shifted along and rotated about the axes of their frame, in place."""
    R = rotation_from_vector(step[..., 3:]) @ T[..., :3, :3]
    return transform(R, T[..., :3, 3] + step[..., :3])


def _count(arms: Sequence[ArmPosterior], one: SharedObject) -> int:
    """Return the number of equations of a shared object: one per parameter and further arm."""
    return len(arms[one.arms[0]].shared_objects[one.key][1]) * (len(one.arms) - 1)


def _used(arms: Sequence[ArmPosterior], shared: Sequence[SharedObject]) -> list[list[int]]:
    """Return the indices of the parameters of every arm on which the equations depend."""
    used: list[set[int]] = [set() for _ in arms]
    for one in shared:
        for number in one.arms:
            frame, rows = arms[number].shared_objects[one.key]
            used[number] |= {*rows, *arms[number].base_rows(frame)}
    return [sorted(rows) for rows in used]


def _in_base(
    arm: ArmPosterior, key: tuple[str, str], values: Callable[[Sequence[int]], Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the pose of a shared object in the base of an arm, and the other unknowns of its sensor."""
    frame, rows = arm.shared_objects[key]
    T_base_frame = invert(transform_from_xyzrpy(values(arm.base_rows(frame))))
    if key[0] == "frame":
        return T_base_frame, values(())
    point = transform(torch.eye(3, dtype=torch.float64), values(rows[:3]))
    return T_base_frame @ point, values(rows[3:])


def _linearised(
    arms: Sequence[ArmPosterior],
    shared: Sequence[SharedObject],
    T: Float64[Tensor, "arms 4 4"],
    z: Sequence[Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return derivatives of all equations with respect to z and the steps of the bases, and their values."""
    used = _used(arms, shared)
    roots = [arm.root[rows] for arm, rows in zip(arms, used, strict=True)]
    now = [arm.values[rows] + R @ one for arm, rows, R, one in zip(arms, used, roots, z, strict=True)]
    sizes = [len(rows) for rows in used]
    places = [{row: place for place, row in enumerate(rows)} for rows in used]

    def equations(unknowns: Tensor) -> Tensor:
        steps = unknowns[sum(sizes) :].view(-1, 6)
        bases = torch.cat([T[:1], _moved(T[1:], steps)])
        parts = torch.split(unknowns[: sum(sizes)], sizes)
        return torch.cat(list(_equations(arms, shared, bases, parts, places)))

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

            pose, more = _in_base(arms[number], one.key, values)
            seen.append((bases[number] @ pose, more))
        for pose, more in seen[1:]:
            error = pose_error(pose, seen[0][0])
            yield torch.cat([error if one.kind == "frame" else error[:3], more - seen[0][1]])


def _pose(arm: ArmPosterior, key: tuple[str, str]) -> Float64[Tensor, "4 4"]:
    """Return the pose of a shared object in the base of an arm, according to the fit of this arm."""
    return _in_base(arm, key, lambda rows: arm.values[list(rows)])[0]


def _distance(arms: Sequence[ArmPosterior], one: SharedObject, T: Float64[Tensor, "arms 4 4"]) -> float:
    """Return the largest distance between the positions of a shared object by the fits of two arms [m]."""
    there = torch.stack([(T[number] @ _pose(arms[number], one.key))[:3, 3] for number in one.arms])
    return float(torch.cdist(there, there).max())


def _start(arms: Sequence[ArmPosterior], shared: Sequence[SharedObject]) -> list[Float64[Tensor, "4 4"]]:
    """Return a base for every arm, from a frame shared with an earlier arm, or else from shared points."""
    placed = {0: torch.eye(4, dtype=torch.float64)}
    while len(placed) < len(arms):
        for number in range(len(arms)):
            if number in placed:
                continue
            found = _place(arms, shared, placed, number)
            if found is not None:
                placed[number] = found
                break
        else:
            lost = [arm.name for number, arm in enumerate(arms) if number not in placed]
            raise IdentificationError(
                expected=f"a frame, or {_MIN_POINTS} sockets or anchors that are not on one line, that arm "
                f"'{lost[0]}' shares with the other arms",
                value=Phrase(", ".join(f"{one.kind} '{one.name}'" for one in shared) or "none"),
                remedy="name the same board, jig or instrument in the column 'frame' of the rows of both arms, or the "
                "same sockets in the column 'socket'",
            )
    return [placed[number] for number in range(len(arms))]


def _place(
    arms: Sequence[ArmPosterior], shared: Sequence[SharedObject], placed: dict[int, Tensor], number: int
) -> Float64[Tensor, "4 4"] | None:
    """Return the base of an arm from what it shares with arms of known bases; None if this does not determine it."""
    wanted, own = [], []
    for one in shared:
        known = [other for other in one.arms if other in placed]
        if number not in one.arms or not known:
            continue
        there = placed[known[0]] @ _pose(arms[known[0]], one.key)
        mine = _pose(arms[number], one.key)
        if one.kind == "frame":
            return there @ invert(mine)
        wanted.append(there[:3, 3])
        own.append(mine)
    if len(own) < _MIN_POINTS:
        return None
    points = torch.stack(wanted)
    spread = torch.linalg.svdvals(points - points.mean(0))
    if spread[1] <= _COLLINEAR * spread[0]:
        return None
    return best_base(torch.stack(own), MeasuredPoses.from_tensors(points, None, 0.0))

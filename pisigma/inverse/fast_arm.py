"""Joint values of an identified arm for many poses at once, by the shortest way; each is checked on the arm itself."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.hybrid.arms import HybridArm
from pisigma.inverse.newton_steps import MovingArm, select_rows
from pisigma.joint_correction.batched_correction import BatchedCorrection
from pisigma.kinematics.components import Columns, Frame
from pisigma.kinematics.numeric import SINGULAR_TOLERANCE
from pisigma.kinematics.singularity import singularity_measure
from pisigma.robot.description import Robot

STEPS = 3
"""Newton steps that nearly all poses are solved with: from a degree to 1e-3, 1e-7 and 1e-15 rad."""

CLOSE = 0.05
"""Error [reach or rad] from which on Newton steps are tried."""

DAMPED, NEARLY, LAST = 50, 1e-6, 2
"""For the few poses that are left: damped steps at most, until this near [reach or rad], and Newton steps then."""

STANDSTILL = 1e-7
"""[m and rad] What is left after them where they lead nowhere."""

ACCEPTED = 1e-11
"""[m and rad] Residuals that a solution has at most."""

REGULAR = 1e-4
"""A bound from below on the smallest singular value; where it is smaller the value itself is computed."""

SETTLED = 2e-12
"""[rad] Left of an error of `q + Δ(q)`."""

_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Followed:
    """What `FastArm.follow` found.

    Attributes:
        q: joint values [rad], near the start.
        share: of the learned correction that is in force there; 1 for an arm without one.
        good: whether they reach the pose; elsewhere q is of no use.
        singular: whether they are singular there.
        lost: where damped steps came to a standstill away from the pose, so that nothing leads there.
    """

    q: Float64[Tensor, "dof poses"]
    share: Float64[Tensor, " poses"]
    good: Bool[Tensor, " poses"]
    singular: Bool[Tensor, " poses"]
    lost: Bool[Tensor, " poses"]


class FastArm:
    """An arm of six revolute joints as identified, with or without a joint correction.

    For the hybrid arm `p = q + Δ(q)` is solved for on its geometry by Newton steps, then q by
    `q ← q + (p - q - Δ(q)) / (1 + slope)`: the correction is evaluated a few times only, and never differentiated but
    by the joint's own value. That holds where the whole correction is in force, and where none is the geometric arm
    stands alone; between the two the arm is neither and nothing is found.
    """

    def __init__(self, geometric: Robot, hybrid: HybridArm | None) -> None:
        """Prepare an arm; see `suits`."""
        self._geometric = MovingArm(geometric)
        self._hybrid = MovingArm(hybrid.hybrid) if hybrid is not None else None
        self._correction = BatchedCorrection(hybrid.correction) if hybrid is not None else None
        self._coverage = hybrid.coverage if hybrid is not None else None

    @staticmethod
    def suits(robot: Robot) -> bool:
        """Whether an arm has six joints, all revolute."""
        return robot.dof == 6 and all(robot.revolute)

    def follow(
        self, T_base_tool: Frame, start: Float64[Tensor, "dof poses"], patient: bool = False
    ) -> Followed:
        """Joint values near the start that take the tool to the poses.

        Args:
            T_base_tool: the poses, on components.
            start: joint values [rad].
            patient: take damped steps where Newton steps fail.
        """
        if self._hybrid is None:
            q, good, singular, lost = self._on(self._geometric, T_base_tool, start, patient)
            return Followed(q, torch.ones_like(q[0]), good, singular, lost)
        p, good, singular, lost = self._on(self._hybrid, T_base_tool, start, patient)
        q, settled = self._before_correction(p)
        share = self._share(q)
        good &= settled & (share == 1)
        beyond = (share == 0).nonzero()[:, 0]
        if len(beyond):
            part = select_rows(T_base_tool, beyond)
            found = self._on(self._geometric, part, start[:, beyond], patient)
            q[:, beyond], good[beyond], singular[beyond], _ = found
            good[beyond] &= self._share(q[:, beyond]) == 0
        return Followed(q, share, good, singular, lost & (share == 1))

    def _on(self, arm: MovingArm, T: Frame, start: Tensor, patient: bool) -> tuple[Tensor, ...]:
        """Joint values of one geometry, where they reach the pose, where they are singular, and where none reach."""
        wanted = arm.wanted(T)
        q, good, steady, least = _newton(arm, wanted, start, STEPS)
        left = (steady & ~good).nonzero()[:, 0]
        if len(left):
            q[:, left], good[left], steady[left], least[left] = _newton(
                arm, select_rows(wanted, left), q[:, left], LAST
            )
        good, lost = good & steady, torch.zeros_like(good)
        left = (~good).nonzero()[:, 0]
        if patient and len(left):
            part = select_rows(wanted, left)
            nearer = arm.approach(part, start[:, left], DAMPED, NEARLY)
            lost[left] = arm.residual(part, nearer) > STANDSTILL
            q[:, left], good[left], _, least[left] = _newton(arm, part, nearer, LAST)
        singular = torch.zeros_like(good)
        doubtful = (good & ~(least > REGULAR)).nonzero()[:, 0]
        if len(doubtful):
            singular[doubtful] = singularity_measure(arm.robot, q[:, doubtful].T) < SINGULAR_TOLERANCE
        return q, good, singular, lost & ~good

    def _before_correction(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Q with `q + Δ(q) = p`, and where that holds.

        Changes shrink by about the same factor every time, so the largest of two rounds say what is left of each.
        """
        assert self._correction is not None
        delta, slope = self._correction(p, slope=True)
        gain = 1 / (1 + slope)
        change = delta * gain
        q, settled, before = p - change, torch.zeros_like(p[0], dtype=torch.bool), _largest(change)
        rows, found = torch.arange(p.shape[1]), q
        for _ in range(_ROUNDS):
            if not len(rows):
                break
            change = (p - found - self._correction(found)[0]) * gain
            found, largest = found + change, _largest(change)
            factor, before = largest / before if before else 0.0, largest
            done = change.abs().amax(0) * factor < SETTLED
            q[:, rows], settled[rows] = found, done
            left = (~done).nonzero()[:, 0]
            rows, p, found, gain = rows[left], p[:, left], found[:, left], gain[:, left]
        return q, settled

    def _share(self, q: Tensor) -> Tensor:
        assert self._coverage is not None
        return self._coverage.share(q.T)


def _largest(change: Tensor) -> float:
    """The largest finite absolute value; 0 of none."""
    return float(change.abs().nan_to_num(0.0, posinf=0.0).amax()) if change.numel() else 0.0


def _newton(arm: MovingArm, wanted: Columns, q: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Joint values after some steps, where they reach the pose, where they came nearer steadily, and how singular.

    Near a singular pose steps that are not steady may end on another branch than they began on.
    """
    before = torch.full_like(q[0], CLOSE**2)
    steady = torch.ones_like(before, dtype=torch.bool)
    for _ in range(steps):
        step = arm.step(wanted, q)
        steady &= (step.square < before) | (step.square < 1e-26)
        q, before = step.q, 0.25 * step.square
    return q, arm.residual(wanted, q) < ACCEPTED, steady, step.least

"""Motion of a robot as products of 4x4 matrices: few operations, each dear by the pose, so for few poses.

Written out on components the same takes some six hundred operations, each cheap by the pose; below `FEW` poses the
number of operations is what counts.
"""

import functools

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.kinematics.components import (
    IDENTITY,
    as_transform,
    follow_xyzrpy,
    rotate_x,
    rotate_y,
    rotate_z,
    translate,
)
from pisigma.robot.description import Robot

FEW = 192
"""Fewer poses than this go through matrices."""


class MatrixChain:
    """`T = M_0 · J_1(q_1) M_1 · … · J_n(q_n) M_n` with all that does not move in M.

    A link `J(q) M` is `cos t · P + sin t · Q + R` for a joint that turns, `t = direction · q + theta`, and `t · P + R`
    for one that slides.
    """

    def __init__(self, robot: Robot) -> None:
        """Multiply out what does not move."""
        like = torch.zeros((), dtype=torch.float64)
        still: list[Tensor] = [as_transform(follow_xyzrpy(IDENTITY, robot.base.tolist()), like)]
        for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
            rest = as_transform(rotate_y(rotate_x(translate(IDENTITY, a, 0.0, d), alpha), beta), like)
            if row.type == "revolute":
                still.append(rest)
                continue
            turned = _turning(theta) @ rest
            if row.type == "fixed":
                still[-1] = still[-1] @ turned
            else:
                still.append(turned)
        still[-1] = still[-1] @ as_transform(follow_xyzrpy(IDENTITY, robot.tool.tolist()), like)
        self._first = still[0]
        self._turns, self._all_turn = torch.tensor(robot.revolute), all(robot.revolute)
        parts = [_parts(M, turns) for M, turns in zip(still[1:], robot.revolute, strict=True)]
        self._P, self._Q, self._R = (torch.stack(part) for part in zip(*parts, strict=True))
        self._sign = torch.from_numpy(robot.directions)
        theta = [
            row[0] for row, kind in zip(robot.dh.tolist(), robot.rows, strict=True) if kind.type != "fixed"
        ]
        self._offset = torch.where(self._turns, torch.tensor(theta, dtype=torch.float64), 0.0)

    def motion(
        self, q: Float[Tensor, "poses dof"]
    ) -> tuple[Float[Tensor, "poses 4 4"], Float[Tensor, "poses 6 dof"]]:
        """Tool pose and joint Jacobian, as `joint_jacobian` gives them."""
        P, Q, R = (part.to(q) for part in (self._P, self._Q, self._R))
        sign = self._sign.to(q)
        t = (q * sign + self._offset.to(q))[..., None, None]
        turns = None if self._all_turn else self._turns.to(q.device)[:, None]
        first = t.cos() if turns is None else torch.where(turns[..., None], t.cos(), t)
        frames = [self._first.to(q).expand(len(q), 4, 4)]
        for link in (first * P + t.sin() * Q + R).unbind(1):
            frames.append(frames[-1] @ link)
        frame = frames.pop()
        axis, origin = torch.stack(frames, 1)[:, :, :3, 2:].unbind(-1)
        axis = axis * sign[:, None]
        linear, angular = torch.linalg.cross(axis, frame[:, None, :3, 3] - origin), axis
        if turns is not None:
            linear, angular = torch.where(turns, linear, axis), torch.where(turns, axis, 0.0)
        return frame, torch.cat([linear, angular], -1).mT


def _turning(theta: float) -> Tensor:
    return as_transform(rotate_z(IDENTITY, theta), torch.zeros((), dtype=torch.float64))


def _parts(M: Tensor, turns: bool) -> tuple[Tensor, Tensor, Tensor]:
    """P, Q and R of a link."""
    zero = torch.zeros_like(M)
    P, Q, R = zero.clone(), zero.clone(), M.clone()
    if turns:
        P[0], P[1], Q[0], Q[1] = M[0], M[1], -M[1], M[0]
        R[:2] = 0.0
    else:
        P[2] = M[3]
    return P, Q, R


@functools.lru_cache(maxsize=128)
def matrix_chain(robot: Robot) -> MatrixChain:
    """The chain of a robot, made once."""
    return MatrixChain(robot)

"""Closed form of SCARA robots: joints R R P R with parallel axes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, no_type_check

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form.canonical import canonical_rows
from pisigma.robot.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.robot.kinematics.closed_form.two_link import rounding_tolerance, solve_two_link, two_link
from pisigma.robot.kinematics.components import Frame, Scalar, as_tensors
from pisigma.robot.kinematics.tolerances import NEAREST_MARGIN, TILT_TOLERANCE


@no_type_check
def scara_branches(form: Any, P: Any, only: int, rounding: float, q: Any) -> None:
    """Compute both branches of a SCARA; see `AbstractClosedForm.compiled`."""
    nearest = only < -1
    margin = NEAREST_MARGIN if nearest else 0.0
    # Four joints cannot tilt the tool: its axis must be parallel to axis 1 and point the same way.
    if not nearest and (math.hypot(P[0, 2], P[1, 2]) > max(TILT_TOLERANCE, rounding) or P[2, 2] <= 0):
        return
    # The second link is the diagonal from axis 2 to axis 4, across the rows of joints 2 and 3.
    x, y = form.a[1] + form.a[2] * math.cos(form.theta[2]), form.a[2] * math.sin(form.theta[2])
    length, angle = math.hypot(x, y), math.atan2(y, x)
    zero = form.sign[0] * form.offset[0]
    for branch in range(2):
        if only >= 0 and branch != only:
            continue
        first, elbow, reached = two_link(
            P[0, 3], P[1, 3], form.a[0], length, 1.0 - 2 * branch, zero, rounding, margin
        )
        if reached or nearest:
            t_2 = elbow - angle
            q[branch, 0], q[branch, 1] = first, t_2
            q[branch, 2] = P[2, 3] - form.d[0] - form.d[1]
            # All axes are parallel, so the angles of the revolute joints add up to that of the tool.
            q[branch, 3] = math.atan2(P[1, 0], P[0, 0]) - first - t_2 - form.theta[2]


@dataclass(frozen=True, eq=False)
class Scara(AbstractClosedForm):
    """R R P R with all axes parallel (twists 0 or 180 deg): appendix A of Jeong et al. 1998, for any lengths.

    Branches: `elbow_positive` has a positive sine of the elbow angle, measured about the first row's axis from
    link 1 to link 2, and `elbow_negative` a negative one; they are the two signs of `S_2`, in the appendix's
    order.

    A pose whose tool axis is not parallel to the joint axes is UNREACHABLE. A pose is SINGULAR if the arm is stretched
    or folded, where both branches meet; if it is folded with equal links, axis 4 is on axis 1 and joint 1 is set to 0.
    """

    name = "scara"
    branches = ("elbow_positive", "elbow_negative")
    compiled = staticmethod(scara_branches)

    @classmethod
    def from_robot(cls, robot: Robot) -> "Scara | None":
        """Return the solver, or None unless the joints are R R P R with parallel axes and links longer than 0."""
        rows = canonical_rows(robot, ("revolute", "revolute", "prismatic", "revolute"), (0.0, 0.0, 0.0))
        solver = rows and cls(robot, rows)
        return solver if solver and solver.rows.a[0] != 0 and solver._second_link[0] != 0 else None

    @property
    def _second_link(self) -> tuple[float, float]:
        """Length [m] of link 2 from axis 2 to axis 4, and its angle [rad] at t_2 = 0."""
        x = self.rows.a[1] + self.rows.a[2] * math.cos(self.rows.theta[2])
        y = self.rows.a[2] * math.sin(self.rows.theta[2])
        return math.hypot(x, y), math.atan2(y, x)

    def _solve_components(
        self, T: Frame, signs: Sequence[Scalar]
    ) -> tuple[list[Scalar], Bool[Tensor, "..."], Bool[Tensor, "..."]]:
        rows = self.rows
        length, angle = self._second_link
        (r_00, r_10, _), _, (r_02, r_12, r_22), (x, y, z) = as_tensors(T)
        arm = solve_two_link(x, y, rows.a[0], length, signs[0], rows.variable_at_zero(0), self.margin)
        t_2 = arm.elbow - angle
        d_3 = z - rows.d[0] - rows.d[1]
        # All axes are parallel, so the angles of the revolute joints add up to that of the tool.
        t_4 = torch.atan2(r_10, r_00) - arm.first - t_2 - rows.theta[2]
        tilt = torch.hypot(r_02, r_12)
        upright = (tilt <= max(TILT_TOLERANCE, rounding_tolerance(x.dtype))) & (r_22 > 0)
        return [arm.first, t_2, d_3, t_4], arm.reached & upright, arm.singular

"""Closed-form inverses compared with the formulas of the papers' appendices, as printed."""

import math

import numpy as np
import torch
from testing.closeness import assert_close, joint_distance

from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.se3 import rotation_from_zyx, transform

RIGHT = math.pi / 2


def appendix_a(x, y, z, phi, sign):
    """Jeong et al. 1998, appendix A as printed (lengths in m)."""
    a1 = a2 = 0.320
    d1, d2 = 0.536, -0.089
    C2 = (x**2 + y**2 - a1**2 - a2**2) / (2 * a1 * a2)
    S2 = sign * np.sqrt(1 - C2**2)
    theta2 = np.arctan2(S2, C2)
    theta1 = np.arctan2(y, x) - np.arctan2(S2 * a2, a1 + C2 * a2)
    return np.stack([theta1, theta2, z - d1 - d2, phi - theta1 - theta2], -1)


def test_appendix_a_as_printed_agrees(robots, generator):
    robot = robots.load("kiro3")
    radius = 0.125 + 0.5 * torch.rand(200, generator=generator, dtype=torch.float64)
    angle, phi, z = 3 * torch.rand((3, 200), generator=generator, dtype=torch.float64)
    p = torch.stack([radius * angle.cos(), radius * angle.sin(), z / 10], -1)
    zero = torch.zeros_like(phi)
    solutions = closed_form_solver(robot).solve(
        transform(rotation_from_zyx(torch.stack([phi, zero, zero], -1)), p)
    )
    assert solutions.branches == ("elbow_positive", "elbow_negative")
    for branch, sign in enumerate((1, -1)):
        printed = torch.tensor(appendix_a(*p.T.numpy(), phi.numpy(), sign))
        assert_close(joint_distance(robot, solutions.q[:, branch], printed), 0.0, atol=1e-12)


def appendix_b(p, R, cosine_sign, wrist_sign=1.0):
    """Jeong et al. 1998, appendix B as printed (lengths in m); `wrist_sign` selects the other theta_4."""
    a2, d4 = 0.600, 0.800
    (x, y, z), r = p.T, {(i + 1, j + 1): R[:, i, j] for i in range(3) for j in range(3)}
    t1 = np.arctan2(y, x)
    C1, S1 = np.cos(t1), np.sin(t1)
    S3 = (d4**2 + a2**2 - (x**2 + y**2 + z**2)) / (2 * a2 * d4)
    C3 = cosine_sign * np.sqrt(1 - S3**2)
    t3, ahead = np.arctan2(S3, C3), C1 * x + S1 * y
    C23 = (ahead * (d4 - a2 * S3) + z * a2 * C3) / (z**2 + ahead**2)
    S23 = (ahead * a2 * C3 - (d4 - a2 * S3) * z) / (z**2 + ahead**2)
    S4S5 = r[2, 3] * C1 - r[1, 3] * S1
    C4S5 = -r[3, 3] * C23 - r[1, 3] * C1 * S23 - r[2, 3] * S1 * S23
    t4 = np.arctan2(wrist_sign * S4S5, wrist_sign * C4S5)
    C4, S4 = np.cos(t4), np.sin(t4)
    S4C5 = S4 * (r[1, 3] * C1 * C23 + r[2, 3] * S1 * C23 - r[3, 3] * S23)
    t5 = np.where(S4 > 0, np.arctan2(S4S5, S4C5), np.arctan2(-S4S5, -S4C5))
    S6, C6 = (
        -(
            C1 * S23 * S4 * r[1, k]
            - S1 * C4 * r[1, k]
            + S1 * S23 * S4 * r[2, k]
            + C1 * C4 * r[2, k]
            + C23 * S4 * r[3, k]
        )
        for k in (1, 2)
    )
    return np.stack([t1, np.arctan2(S23, C23) - t3, t3, t4, t5, np.arctan2(S6, C6)], -1)


def test_appendix_b_as_printed_agrees(robots, generator):
    robot = robots.load("kiro4")
    u = torch.rand((300, 6), generator=generator, dtype=torch.float64)
    p = torch.tensor([0.6, 0.0, 0.4]) + 0.4 * u[:, :3]
    home = torch.tensor([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]], dtype=torch.float64)
    R = home @ rotation_from_zyx((u[:, 3:] - 0.5) * RIGHT)
    solutions = closed_form_solver(robot).solve(transform(R, p))
    for sign in (1, -1):
        for wrist in (1, -1):
            printed = torch.tensor(appendix_b(p.numpy(), R.numpy(), sign, wrist))
            distance = joint_distance(robot, solutions.q[:, :4], printed[:, None])
            assert_close(distance.amin(-1), 0.0, atol=1e-9)
            assert distance.argmin(-1).unique().numel() == 1

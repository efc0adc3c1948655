"""Inverse kinematics that raises nothing for poses and joint values that are none, for control loops."""

from dataclasses import replace

import torch

from pisigma.inverse.pose_input import JointLike, PoseLike, as_numbers
from pisigma.inverse.solution import Solution
from pisigma.inverse.torch_ik import TorchIK
from pisigma.kinematics.status import Status
from pisigma.se3 import check_transforms, transform_faults


def solve_what_can_be(
    ik: TorchIK, T_base_tool: PoseLike, near: JointLike | None, branch: str | None
) -> Solution:
    """Solutions as `ik` gives them; status INVALID_POSE and NaN where a matrix is no pose or `near` is not finite.

    Raises:
        PoseError: a shape does not fit, or the branch is unknown.
    """
    given = as_numbers(T_base_tool, "T_base_tool", "homogeneous transforms of shape (*batch, 4, 4)")
    if given.shape[-2:] != (4, 4):
        check_transforms(given, "T_base_tool")
    tolerance = 1e-6 if given.dtype == torch.float64 else 1e-4
    fine = ~torch.stack([bad for bad, _ in transform_faults(given, tolerance)]).any(0)
    T = torch.where(fine[..., None, None], given, torch.eye(4).to(given))
    beside = None
    if near is not None:
        beside = as_numbers(near, "near", "joint values of shape (*batch, joints)")
        finite = torch.isfinite(beside)
        fine = fine & finite.all(-1).to(fine.device).expand(fine.shape)
        beside = torch.where(finite, beside, 0.0)
    found = ik(T, near=beside, branch=branch)
    q, nominal, correction = (
        torch.where(fine[..., None], values, torch.nan)
        for values in (found.q, found.q_nominal, found.correction)
    )
    return replace(
        found,
        q=q,
        q_nominal=nominal,
        correction=correction,
        status=torch.where(fine, found.status, int(Status.INVALID_POSE)),
        domain_measure=torch.where(fine, found.domain_measure, torch.nan),
    )

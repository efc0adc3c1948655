"""What users give as poses and joint values, as tensors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pisigma.errors import PoseError
from pisigma.se3 import check_transforms

PoseLike = Tensor | np.ndarray | Sequence[Any]
"""Matrices `(*batch, 4, 4)`: a tensor, an array or nested lists."""

JointLike = Tensor | np.ndarray | Sequence[Any]
"""Joint values `(*batch, dof)`: a tensor, an array or nested lists."""


def as_numbers(values: PoseLike | JointLike, name: str, wanted: str) -> Tensor:
    """A floating-point tensor; float32 stays, integers become float64."""
    if isinstance(values, Tensor):
        given = values
    else:
        try:
            array = np.asarray(values)
            given = torch.as_tensor(array if array.dtype == np.float32 else array.astype(np.float64))
        except (TypeError, ValueError):
            raise PoseError(f"{name} is no array of numbers; give {wanted}.") from None
    if given.dtype not in (torch.float32, torch.float64):
        raise PoseError(f"{name} holds {given.dtype}; give float64 or float32.")
    return given


def as_poses(poses: PoseLike) -> tuple[Tensor, Tensor]:
    """The poses as float64 on the CPU, and as they were given."""
    given = as_numbers(poses, "T_base_tool", "homogeneous transforms of shape (*batch, 4, 4)")
    check_transforms(given, "T_base_tool", tolerance=1e-6 if given.dtype == torch.float64 else 1e-4)
    return given.detach().to("cpu", torch.float64), given

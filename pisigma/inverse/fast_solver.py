"""Corrected inverse kinematics of many poses, a chunk at a time, for all but the poses that need more care."""

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.inverse.fast_branches import ChunkOfPoses
from pisigma.inverse.fast_model import FastModel
from pisigma.inverse.fast_rows import FastRows
from pisigma.inverse.identified_arm import IdentifiedArm
from pisigma.inverse.patient_poses import PatientPoses

CHUNK = 65_536
"""Poses worked on together: enough for Python not to count and for torch to take a second thread."""

FEW = 8_192
"""Poses that are worked on together patiently, from some starts each."""


class FastSolver:
    """Solutions where the nominal arm has a closed form and the identified one is near it."""

    def __init__(self, identified: IdentifiedArm) -> None:
        """Prepare for an arm; see `FastArm.suits`."""
        self._model = FastModel.of(identified)

    def solve(
        self,
        T: Float64[Tensor, "poses 4 4"],
        near: Float64[Tensor, "poses dof"] | None,
        order: Sequence[int],
    ) -> FastRows:
        """Solve what can be solved quickly: first by Newton steps, then patiently.

        Chunks are not spread over threads, where Python's own lock costs more than a second one gives.

        Args:
            T: wanted poses T_base_tool.
            near: joint values [rad] to be near to, or None.
            order: indices of branches. Without `near`, or where there is one only, the first that leads to the pose
                inside the joint limits is taken, else the first that leads there at all; with it the nearest, those
                inside the limits first.
        """
        found = FastRows.none(len(T), self._model.robot.dof)
        with torch.no_grad():
            for first in range(0, len(T), CHUNK):
                rows = slice(first, first + CHUNK)
                beside = None if near is None else near[rows]
                chunk = ChunkOfPoses(self._model, T[rows], beside, found.select(rows))
                chunk.solve_in_order(order) if near is None or len(order) == 1 else chunk.solve_nearest()
            for left in torch.split((~found.done).nonzero()[:, 0], FEW):
                beside = None if near is None else near[left]
                found.put(left, PatientPoses(self._model, T[left], beside).solve(order))
        return found

"""Whether large errors remain after fitting everything that may have moved."""

import math
from collections.abc import Iterator

import torch

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.robot.frame_fits import best_base_and_tool
from pisigma.validation.checks.rows.row_check import FITTED, STEP, AbstractRowCheck, RowsUnderModel
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.explanations import PLAUSIBLE_SHARE
from pisigma.validation.setup_faults.setup_faults import unexplained

MAX_ITERATIONS = 8
MAX_STEP = 0.3
"""[rad, or share of the reach] Largest step of a joint zero in an iteration."""


class UnexplainedRowsCheck(AbstractRowCheck):
    """Fits all joint zeros, a base and a tool to rows whose errors are too large for a calibrated robot."""

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        limit = PLAUSIBLE_SHARE * judged.model.robot.reach
        if judged.large and not judged.setup_faults and self._left(judged) > limit:
            sentence = unexplained(judged.model)
            yield Diagnostic(kind="implausible_errors", severity="implausible", sentence=sentence)

    def _left(self, judged: RowsUnderModel) -> float:
        """Compute the RMS residual after the fit [m], corrected for its degrees of freedom."""
        known, robot = judged.known, judged.model.robot
        zeros = torch.zeros(known.dof, dtype=torch.float64)
        largest = (
            MAX_STEP
            * torch.tensor([1.0 if revolute else robot.reach for revolute in robot.revolute]).double()
        )
        moves = "joint_zero" in judged.may_move
        least = float("inf")
        for _ in range(MAX_ITERATIONS if moves else 1):
            T = self._poses(judged, zeros)
            # Base and tool have a closed form for given zeros; a Gauss-Newton step of the zeros follows.
            base, tool = best_base_and_tool(T, judged.measured)
            error = judged.measured.position - (base @ T @ tool)[:, :3, 3]
            least = min(least, float(error.square().sum(1).mean().sqrt()))
            columns = []
            for joint in range(known.dof):
                there = self._poses(judged, zeros + STEP * torch.eye(known.dof).double()[joint])
                columns.append((base @ (there - T) @ tool)[:, :3, 3] / STEP)
            J = torch.stack(columns, -1).flatten(0, 1)
            step = torch.linalg.lstsq(J, error.flatten(), driver="gelsd").solution
            zeros = zeros + step.clamp(-largest, largest)
        values = 3 * known.rows
        spare = max(values - FITTED - (known.dof if moves else 0), 1)
        return least * math.sqrt(values / spare)

    def _poses(self, judged: RowsUnderModel, zeros: torch.Tensor) -> torch.Tensor:
        known = judged.known
        return poses_of_rows(
            judged.model, Measurements(known.q + zeros, frame=known.frame, target=known.target)
        )

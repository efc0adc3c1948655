"""Whether all measured lengths are wrong by one factor."""

from collections.abc import Iterator

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.robot.frame_fits import best_base_and_tool
from pisigma.robot.se3 import skew
from pisigma.validation.checks.rows.row_check import FITTED, STEP, AbstractRowCheck, RowsUnderModel
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import length_text

MIN_CHANGE = 5e-4
"""Factors nearer to 1 come from heat: 20 K stretch an aluminium arm by 0.05 %."""
UNUSUAL = 2.0
"""Errors over the expected ones below which no explanation is needed."""
EXPLAINED = 0.6
"""Share of the errors that may remain after correcting the factor."""
AS_GOOD = 1.3
"""Errors under any other explanation must be larger by this factor."""
MIN_DEVIATIONS = 5.0
"""[standard deviations] Difference of the factor from 1 above which it is reported."""


class ScaleOfRowsCheck(AbstractRowCheck):
    """Fits a factor on the measured positions together with base and tool, and compares it with moved joint zeros."""

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        usual = float(judged.usual.square().mean().sqrt())
        single = len(set(judged.rows.frame)) == len(set(judged.rows.target)) == 1
        if not single or 3 * judged.rows.rows < 2 * FITTED or not usual > 0:
            return
        base, tool = best_base_and_tool(judged.unfitted, judged.measured)
        T = base @ judged.unfitted @ tool
        error = (judged.measured.position - T[:, :3, 3]).flatten()
        before, _, _ = _fit(_frames(T), error)
        if not before > UNUSUAL * usual:
            return
        position = (judged.measured.position - judged.measured.position.mean(0)).flatten()
        after, factor, deviation = _fit(torch.cat([_frames(T), position[:, None]], 1), error)
        others = (
            _fit(torch.cat([_frames(T), one[:, None]], 1), error)[0] for one in _joints(judged, base, tool)
        )
        if (
            abs(factor) > max(MIN_CHANGE, MIN_DEVIATIONS * deviation)
            and after < EXPLAINED * before
            and min(others) > AS_GOOD * after
        ):
            yield Diagnostic(
                kind="scale",
                severity="implausible",
                sentence=f"All measured lengths are {1 / (1 - factor):.5g} times as large as the model predicts "
                f"(standard deviation {deviation:.1g}); with this factor corrected, the errors fall from "
                f"{length_text(before)} to {length_text(after)} RMS; check the unit and the scale of the instrument, "
                "its temperature and that of the robot.",
                values={"factor": 1 / (1 - factor), "sigma": deviation},
            )


def _frames(T: Float64[Tensor, "rows 4 4"]) -> Float64[Tensor, "values numbers"]:
    """Differentiate positions by small motions of the base and by shifts of the tool."""
    eye = torch.eye(3).to(T).expand(len(T), 3, 3)
    return torch.cat([eye, -skew(T[:, :3, 3]), T[:, :3, :3]], 2).flatten(0, 1)


def _joints(judged: RowsUnderModel, base: Tensor, tool: Tensor) -> Iterator[Float64[Tensor, " values"]]:
    """Differentiate positions by the zero of every joint, by finite differences."""
    known, here = judged.known, base @ judged.unfitted @ tool
    for joint in range(known.dof):
        q = known.q.clone()
        q[:, joint] += STEP
        there = (
            base @ poses_of_rows(judged.model, Measurements(q, frame=known.frame, target=known.target)) @ tool
        )
        yield ((there - here)[:, :3, 3] / STEP).flatten()


def _fit(
    A: Float64[Tensor, "values numbers"], error: Float64[Tensor, " values"]
) -> tuple[float, float, float]:
    """Solve least squares; return the RMS length of the residuals [m], the last unknown, and its standard deviation."""
    scale = A.norm(dim=0).clamp(min=1e-300)
    U, size, V = torch.linalg.svd(A / scale, full_matrices=False)
    certain = size > 1e-6 * size[0]
    U, size, V = U[:, certain], size[certain], V[certain]
    x = V.t() @ (U.t() @ error / size)
    spare = max(len(error) - len(size), 1)
    variance = float((error - U @ (U.t() @ error)).square().sum()) / spare
    deviation = (variance * float((V[:, -1] / size).square().sum())) ** 0.5
    return (3 * variance) ** 0.5, float(x[-1] / scale[-1]), deviation / float(scale[-1])

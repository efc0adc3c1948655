"""Whether all lengths are off by one factor: a wrong unit, or the scale of the instrument."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pisigma.identification.problem.noise import UNDETERMINED, view_of
from pisigma.identification.problem.parameters import USUAL_LENGTH
from pisigma.identification.result import CalibrationResult
from pisigma.judging.diagnostic import Diagnostic
from pisigma.verification.checks.check import AbstractCheck, CheckedCalibration

SCALE_SIGMA = 0.1
"""Prior standard deviation of a common factor on the lengths."""
PRIOR_SCALES = np.geomspace(0.03, 1e3, 40)
"""Sizes of the errors of single lengths, in the prior's standard deviations, that are tried."""
SUBSTANTIAL = math.log(3.0)
"""Logarithm of the Bayes factor from which on a common factor is reported (Kass and Raftery 1995, JASA 90, 773-795:
"positive")."""
IMPLAUSIBLE = 0.03
"""A factor that is off by more comes from a wrong unit or another robot. Heat stretches arms and instruments by less
than 0.2 %, and a scale bar that is used wrongly by 1 %."""


@dataclass(frozen=True)
class CommonScale:
    """One factor on all lengths of an arm.

    Attributes:
        factor: fitted lengths over drawn ones.
        sigma: its standard deviation.
        log_bayes_factor: logarithm of the odds of a factor that is not 1, before what was known of the setup.
    """

    factor: float
    sigma: float
    log_bayes_factor: float


class ScaleCheck(AbstractCheck):
    """Looks for a factor that all lengths have in common, beside errors of each."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        scale = common_scale(checked.geometric)
        if scale is None or scale.log_bayes_factor < SUBSTANTIAL:
            return
        implausible = abs(scale.factor - 1) > IMPLAUSIBLE
        lengths = (
            "lengths of the board, and whether the intrinsics of the camera are those of these images"
            if "corner" in checked.rows.kinds
            else "unit of the position columns, the scale of the instrument and stated distances"
        )
        yield Diagnostic(
            kind="scale",
            severity="implausible" if implausible else "warning",
            sentence=f"All lengths of the arm come out {scale.factor:.5g} times as large as drawn (standard deviation "
            f"{scale.sigma:.1g}), which looks like a wrong unit or scale of the measurements; check the {lengths}.",
        )


def common_scale(result: CalibrationResult) -> CommonScale | None:
    """Estimate a factor on all lengths of the arm by its evidence.

    The drawn lengths L are believed to come out as `(1 + s) L + e`, the errors e being normal with the prior's standard
    deviations times one factor, which is as likely as can be with s and without (empirical Bayes). The data enter by
    their normal equations at the solution, from which the prior is taken out. With the normal matrix N of the data,
    their right-hand side b, and the prior precision P of all parameters, the evidence of s is normal, with the
    information `L^T P L - L^T P (N + P)^-1 P L` and the estimate `L^T P (N + P)^-1 b` over it.

    Returns:
        None where no drawn length was estimated.
    """
    problem, here = result.solved.problem, result.solved.refined
    stated = problem.precision[problem.active]
    precision = view_of(here).scaled(stated, problem.prior_group).numpy()
    parameters = [problem.space.parameters[index] for index in problem.active.tolist()]
    lengths = problem.nominal[problem.active].numpy()
    drawn = np.array([one.group in ("a", "d") for one in parameters]) & (np.abs(lengths) > USUAL_LENGTH)
    if not drawn.any():
        return None
    lengths = np.where(drawn, lengths, 0.0)
    right = here.normal.numpy() @ (here.point - problem.nominal)[problem.active].numpy()
    data = here.normal.numpy() - np.diag(precision)
    of_one = np.where(stated[drawn] > 0, stated[drawn], USUAL_LENGTH**-2)
    plain, scaled = [], []
    for size in PRIOR_SCALES:
        precision[drawn] = of_one / size**2
        normal = data + np.diag(precision)
        diagonal = normal.diagonal()
        column = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled_normal = normal * column * column[:, None]
        root = np.linalg.cholesky(scaled_normal + UNDETERMINED * np.eye(len(column)))
        pull = precision * lengths
        u, v = np.linalg.solve(root, (column * np.stack([right, pull])).T).T
        evidence = np.log(precision[drawn]).sum() / 2 - np.log(root.diagonal() / column).sum() + u @ u / 2
        information = lengths @ pull - v @ v
        plain.append(evidence)
        scaled.append((evidence + (u @ v) ** 2 / information / 2, u @ v / information, information**-0.5))
    best, scale, sigma = max(scaled)
    gain = best - max(plain) + math.log(min(sigma / SCALE_SIGMA, 1.0))
    return CommonScale(1 + float(scale), float(sigma), float(gain))

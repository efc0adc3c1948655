"""Whether all lengths are off by one factor: a wrong unit, or the scale of the instrument."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import logsumexp

from pisigma.calibration.geometric.problem.noise import UNDETERMINED, view_of
from pisigma.calibration.geometric.problem.parameters import USUAL_LENGTH
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.calibration_summary import ScaleFigures
from pisigma.validation.held_out.diagnostic import Diagnostic

SCALE_SIGMAS = (0.003, 0.1)
"""Prior standard deviations of a common factor on the lengths, equally likely: of instruments and heat, and of wrong
units."""
LENGTH_ERRORS = np.geomspace(3e-5, 1.0, 40)
"""[m] Standard deviations of the errors of single lengths, equally likely."""
STRONG = math.log(10.0)
"""Logarithm of the Bayes factor from which on a common factor is reported (Jeffreys 1961, Theory of Probability,
appendix B: "strong").

Nothing but drawn lengths says what the scale is, and links of 0.5 m that err by 0.3 mm are like a factor that errs by
0.0004: of 600 simulated arms 5 are reported, and with a factor of 1.001 61 are. The most powerful test (Neyman and
Pearson 1933) with as few false alarms, which knows how links err, would find a factor of 1.001 in half of the KR 10."""
IMPLAUSIBLE = 0.03
"""A factor that is off by more comes from a wrong unit or another robot. Heat stretches arms and instruments by less
than 0.2 %, and a scale bar that is used wrongly by 1 %."""


MOST_ODDS = 1e6
"""Larger odds say no more than these."""


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

    @property
    def odds(self) -> float:
        """Odds of such a factor against links that err each by itself, at most `MOST_ODDS`."""
        return math.exp(min(self.log_bayes_factor, math.log(MOST_ODDS)))


class ScaleCheck(AbstractCheck):
    """Looks for a factor that all lengths have in common, beside errors of each."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        scale = common_scale(checked.geometric)
        if scale is None or scale.log_bayes_factor < STRONG:
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
            f"{scale.sigma:.1g}), which looks like a wrong unit or scale of the measurements: it is "
            f"{scale.odds:.2g} times as likely as links that each err by "
            f"themselves; check the {lengths}.",
        )


def scale_figures(checked: CheckedCalibration) -> ScaleFigures | None:
    """What a factor on all measured positions would explain, and by how much true positions were then off.

    An arm whose joints all turn meets positions that are larger by a factor as well if base, links and tool are larger
    by it, so that no row shows it; only drawn lengths do.

    Returns:
        None where no position was measured, a joint slides, or no drawn length was estimated.
    """
    position = checked.rows.position
    if position is None or any(joint.type == "prismatic" for joint in checked.robot.joints):
        return None
    scale = common_scale(checked.geometric)
    if scale is None:
        return None
    measured, squares = torch.isfinite(position).all(1), position.new_zeros(())
    for frame in set(checked.rows.frame):
        inside = position[measured & torch.tensor([name == frame for name in checked.rows.frame])]
        squares += (inside - inside.mean(0)).square().sum() if len(inside) else 0.0
    spread = float((squares / measured.sum().clamp(min=1)).sqrt())
    return ScaleFigures(
        factor=scale.factor,
        sigma=scale.sigma,
        odds=scale.odds,
        rms_mm=abs(scale.factor - 1) * spread * 1e3,
    )


def common_scale(result: CalibrationResult) -> CommonScale | None:
    """Estimate a factor on all lengths of the arm by its evidence.

    The drawn lengths L are believed to come out as `(1 + s) L + e`, and lengths drawn as 0 as e. The errors e are
    normal with one standard deviation, over which the evidence is averaged with s and without. The data enter by
    their normal equations at the solution, from which the prior is taken out. With the normal matrix N of the data,
    their right-hand side b, and the prior precision P of all parameters, the likelihood of s is normal, with the
    information `L^T P L - L^T P (N + P)^-1 P L` and the estimate `L^T P (N + P)^-1 b` over it.

    Returns:
        None where no drawn length was estimated.
    """
    problem, here = result.solved.problem, result.solved.refined
    precision = view_of(here).scaled(problem.precision[problem.active], problem.prior_group).numpy()
    parameters = [problem.space.parameters[index] for index in problem.active.tolist()]
    nominal = problem.nominal[problem.active].numpy()
    erring = np.array([one.group in ("a", "d") for one in parameters])
    lengths = np.where(erring & (np.abs(nominal) > USUAL_LENGTH), nominal, 0.0)
    if not lengths.any():
        return None
    right = here.normal.numpy() @ (here.point - problem.nominal)[problem.active].numpy()
    data = here.normal.numpy() - np.diag(precision)
    plain, estimate, information = np.empty((3, len(LENGTH_ERRORS)))
    for k, error in enumerate(LENGTH_ERRORS):
        precision[erring] = error**-2
        normal = data + np.diag(precision)
        diagonal = normal.diagonal()
        column = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled_normal = normal * column * column[:, None]
        root = np.linalg.cholesky(scaled_normal + UNDETERMINED * np.eye(len(column)))
        pull = precision * lengths
        u, v = np.linalg.solve(root, (column * np.stack([right, pull])).T).T
        plain[k] = np.log(precision[erring]).sum() / 2 - np.log(root.diagonal() / column).sum() + u @ u / 2
        information[k] = lengths @ pull - v @ v
        estimate[k] = u @ v / information[k]
    ratio = np.square(SCALE_SIGMAS)[:, None] * information
    gain = (np.square(estimate) * information * ratio / (1 + ratio) - np.log1p(ratio)) / 2
    scaled = plain + gain
    best = np.unravel_index(scaled.argmax(), scaled.shape)[1]
    return CommonScale(
        factor=1 + float(estimate[best]),
        sigma=float(information[best] ** -0.5),
        log_bayes_factor=float(logsumexp(scaled) - logsumexp(plain) - math.log(len(SCALE_SIGMAS))),
    )

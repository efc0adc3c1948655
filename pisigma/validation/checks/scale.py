"""Check whether all lengths of the arm are wrong by one factor: a wrong unit, or the scale of the instrument."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from scipy.special import logsumexp
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import UNDETERMINED, contributions_and_noise_of
from pisigma.calibration.geometric.problem.parameters import USUAL_LENGTH
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.robot.frame_fits import best_base_and_tool
from pisigma.robot.se3 import skew
from pisigma.validation.checks.check import FITTED_PARAMETERS, CheckedCalibration, RowsUnderModel
from pisigma.validation.held_out.calibration_summary import ScaleFigures
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import length_text

_SCALE_SIGMAS = (0.003, 0.1)
"""Equally probable prior standard deviations of a common factor on the lengths: one for instruments and heat, and one
for wrong units."""
_LENGTH_ERRORS = np.geomspace(3e-5, 1.0, 40)
"""Equally probable standard deviations of the errors of individual lengths [m]."""
_STRONG = math.log(10.0)
"""Logarithm of the Bayes factor above which a common factor is reported (Jeffreys 1961, Theory of Probability, appendix
B: "strong").

Only nominal lengths determine the scale, and errors of 0.3 mm in links of 0.5 m give the factor an error of 0.0004. Of
600 simulated arms, 5 are reported without a factor, and 61 with a factor of 1.001. The most powerful test (Neyman and
Pearson 1933) with as few false alarms, which knows the distribution of link errors, finds a factor of 1.001 in half of
the simulated KR 10 arms."""
_IMPLAUSIBLE = 0.03
"""Difference of the factor from 1 above which the unit or the robot is wrong. Heat stretches arms and instruments by
less than 0.2 %; wrong use of a scale bar causes 1 %."""


MAX_ODDS = 1e6
"""Largest odds that are reported."""


@dataclass(frozen=True)
class CommonScale:
    """A common factor on all lengths of an arm.

    Attributes:
        factor: ratio of fitted to nominal lengths [1].
        sigma: standard deviation of the factor [1].
        log_bayes_factor: logarithm of the odds of a factor other than 1 against 1, at equal prior odds.
    """

    factor: float
    sigma: float
    log_bayes_factor: float

    @property
    def odds(self) -> float:
        """Odds of a common factor against independent errors of the links, limited to `MAX_ODDS`."""
        return math.exp(min(self.log_bayes_factor, math.log(MAX_ODDS)))


def check_scale(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Look for a common factor on all lengths, in addition to independent errors of every length."""
    scale = common_scale(checked.geometric)
    if scale is None or scale.log_bayes_factor < _STRONG:
        return
    implausible = abs(scale.factor - 1) > _IMPLAUSIBLE
    lengths = (
        "lengths of the board, and that the intrinsics belong to the camera of these images"
        if "corner" in checked.rows.kinds
        else "unit of the position columns, the scale of the instrument and stated distances"
    )
    yield Diagnostic(
        kind="scale",
        severity="implausible" if implausible else "warning",
        sentence=f"All lengths of the arm are estimated {scale.factor:.5g} times as large as nominal (standard "
        f"deviation {scale.sigma:.1g}), which indicates a wrong unit or scale of the measurements: this is "
        f"{scale.odds:.2g} times as likely as independent errors of the links; check the {lengths}.",
        values={"factor": scale.factor, "sigma": scale.sigma, "odds": scale.odds},
    )


def scale_figures(checked: CheckedCalibration) -> ScaleFigures | None:
    """Estimate a factor on all measured positions, and the error of true positions that it causes.

    An arm that has only revolute joints fits scaled positions equally well with base, links and tool scaled by the same
    factor. The residuals therefore do not show the factor; only the nominal lengths do.

    Returns:
        The figures; None if no position was measured, a joint is prismatic, or no nominally nonzero length was
        estimated.
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
        rms_mm_if_sensor_error=abs(scale.factor - 1) * spread * 1e3,
    )


def common_scale(result: CalibrationResult) -> CommonScale | None:
    """Estimate a factor on all lengths of the arm by Bayesian model comparison.

    The model of the true lengths is `(1 + s) L + e` with the nominal lengths L, and e for lengths that are nominally 0.
    The errors e are normal with one standard deviation, over which the evidence with and without s is averaged. The
    data enter through their normal equations at the solution, from which the prior is subtracted. With the normal
    matrix N of the data, their right-hand side b, and the prior precision P of all parameters, the likelihood of s is
    normal, with the information `L^T P L - L^T P (N + P)^-1 P L` and the estimate `L^T P (N + P)^-1 b` divided by this
    information.

    Returns:
        The factor; None if no nominally nonzero length was estimated.
    """
    problem, here = result.solved.problem, result.solved.refined_linearisation
    precision = (
        contributions_and_noise_of(here)
        .scaled_precision(problem.precision[problem.active], problem.prior_group)
        .numpy()
    )
    parameters = [problem.space.parameters[index] for index in problem.active.tolist()]
    nominal = problem.prior_mean[problem.active].numpy()
    erring = np.array([one.group in ("a", "d") for one in parameters])
    lengths = np.where(erring & (np.abs(nominal) > USUAL_LENGTH), nominal, 0.0)
    if not lengths.any():
        return None
    # At the solution, (N + P) (x - nominal) = b, because the nominal values are the mean of the prior.
    right = here.normal.numpy() @ (here.point - problem.prior_mean)[problem.active].numpy()
    data = here.normal.numpy() - np.diag(precision)
    plain, estimate, information = np.empty((3, len(_LENGTH_ERRORS)))
    for k, error in enumerate(_LENGTH_ERRORS):
        precision[erring] = error**-2
        normal = data + np.diag(precision)
        diagonal = normal.diagonal()
        # Scaled to a unit diagonal, because metres and radians make the matrix too ill-conditioned for a Cholesky
        # factor.
        column = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled_normal = normal * column * column[:, None]
        root = np.linalg.cholesky(scaled_normal + UNDETERMINED * np.eye(len(column)))
        # `pull` is the change of the right-hand side per unit of s: the prior is centred at (1 + s) L instead of L.
        pull = precision * lengths
        u, v = np.linalg.solve(root, (column * np.stack([right, pull])).T).T
        plain[k] = np.log(precision[erring]).sum() / 2 - np.log(root.diagonal() / column).sum() + u @ u / 2
        information[k] = lengths @ pull - v @ v
        estimate[k] = u @ v / information[k]
    # The product of the normal prior and the normal likelihood of s integrates in closed form.
    ratio = np.square(_SCALE_SIGMAS)[:, None] * information
    gain = (np.square(estimate) * information * ratio / (1 + ratio) - np.log1p(ratio)) / 2
    scaled = plain + gain
    best = np.unravel_index(scaled.argmax(), scaled.shape)[1]
    return CommonScale(
        factor=1 + float(estimate[best]),
        sigma=float(information[best] ** -0.5),
        log_bayes_factor=float(logsumexp(scaled) - logsumexp(plain) - math.log(len(_SCALE_SIGMAS))),
    )


_MIN_CHANGE = 5e-4
"""Smallest difference of the factor from 1 that is reported; heat causes smaller ones: 20 K stretch an aluminium arm by
0.05 %."""
_UNUSUAL = 2.0
"""Ratio of errors to expected errors below which no explanation is needed."""
_EXPLAINED_BY_SCALE = 0.6
"""Largest share of the errors that may remain after correction of the factor."""
_AS_GOOD_AS_SCALE = 1.3
"""Smallest ratio of the errors under every other explanation to those with the factor at which it is reported."""
_MIN_DEVIATIONS = 5.0
"""Difference of the factor from 1, in standard deviations, above which it is reported."""


def check_scale_of_rows(judged: RowsUnderModel) -> Iterator[Diagnostic]:
    """Fit a factor on the measured positions together with base and tool, and compare it with moved joint zeros."""
    usual = float(judged.predicted_sigma.square().mean().sqrt())
    single = len(set(judged.rows.frame)) == len(set(judged.rows.target)) == 1
    if not single or 3 * judged.rows.rows < 2 * FITTED_PARAMETERS or not usual > 0:
        return
    base, tool = best_base_and_tool(judged.poses_before_fit, judged.measured)
    T = base @ judged.poses_before_fit @ tool
    error = (judged.measured.position - T[:, :3, 3]).flatten()
    before, _, _ = _fit(_frames(T), error)
    if not before > _UNUSUAL * usual:
        return
    position = (judged.measured.position - judged.measured.position.mean(0)).flatten()
    after, factor, deviation = _fit(torch.cat([_frames(T), position[:, None]], 1), error)
    zeros = (base @ judged.poses_with_moved_zeros()[1] @ tool)[..., :3, 3].flatten(1)
    others = (_fit(torch.cat([_frames(T), one[:, None]], 1), error)[0] for one in zeros)
    if (
        abs(factor) > max(_MIN_CHANGE, _MIN_DEVIATIONS * deviation)
        and after < _EXPLAINED_BY_SCALE * before
        and min(others) > _AS_GOOD_AS_SCALE * after
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
    """Return the derivatives of positions with respect to small motions of the base and shifts of the tool."""
    eye = torch.eye(3).to(T).expand(len(T), 3, 3)
    return torch.cat([eye, -skew(T[:, :3, 3]), T[:, :3, :3]], 2).flatten(0, 1)


def _fit(
    A: Float64[Tensor, "values numbers"], error: Float64[Tensor, " values"]
) -> tuple[float, float, float]:
    """Return RMS length of the least-squares residuals [m], the last unknown, and its standard deviation."""
    scale = A.norm(dim=0).clamp(min=1e-300)
    U, size, V = torch.linalg.svd(A / scale, full_matrices=False)
    # If rotations are similar, shifts of base and tool have equal effects; omit what the rows do not determine.
    certain = size > 1e-6 * size[0]
    U, size, V = U[:, certain], size[certain], V[certain]
    x = V.t() @ (U.t() @ error / size)
    spare = max(len(error) - len(size), 1)
    variance = float((error - U @ (U.t() @ error)).square().sum()) / spare
    deviation = (variance * float((V[:, -1] / size).square().sum())) ** 0.5
    return (3 * variance) ** 0.5, float(x[-1] / scale[-1]), deviation / float(scale[-1])

"""Compare alternative causes of residuals by their evidence and by the share of the residuals that each explains."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.estimation.cholesky import covariance_factor, orthonormal_columns
from pisigma.estimation.drift import compressed_columns, evidence_coordinates, evidence_gains

_SIZES = torch.logspace(-3, 1.5, 28, dtype=torch.float64)
"""Sizes of a cause relative to its scale, all equally probable."""
_NOISE = torch.logspace(-2, 2, 41, dtype=torch.float64)
"""Factors on the noise that are tried."""
_STATED_SPREAD = 0.3
"""Prior standard deviation of the logarithm of the factor if the noise is stated."""
CLEAR = 5.0
"""Log Bayes factor [nats] above which residuals have a cause: odds of 150 to 1."""
_MAX_CAUSES = 3


@dataclass(frozen=True)
class Cause:
    """A possible cause of residuals.

    Attributes:
        name: name of the cause.
        log_bayes_factor: log evidence with this cause alone, minus that with noise alone [nats].
        size: most probable size relative to the scale of the cause.
        explained_share: share of the squared residuals, in units of the noise, that the cause alone explains at
            this size.
        named: whether the evidence supports the cause, because it is the clearest one, or clear in addition to clearer
            ones.
    """

    name: str
    log_bayes_factor: float
    size: float
    explained_share: float
    named: bool = False


@dataclass(frozen=True, eq=False)
class FitResiduals:
    """Residuals of a linear fit without priors, and their possible causes.

    The residuals are normal with the covariance `A A^T + s² Z Z^T + (f σ)²`, where A contains the derivatives along
    quantities known with a stated uncertainty, and Z those with respect to the unknowns of a cause. Fitted unknowns are
    projected out, which yields the restricted likelihood (Harville 1974, Biometrika 61(2), 383-385). The evidence of a
    cause is the mean over its sizes s and noise factors f; the difference of two log evidences is a log Bayes factor
    (Kass and Raftery 1995, J. Am. Stat. Assoc. 90(430), 773-795).

    Attributes:
        y: projected residuals in units of the stated noise.
        covariance: projected covariance due to quantities known with a stated uncertainty and due to included causes.
        exact: projected unit vectors of the values whose noise is exactly as stated, such as that of a prior.
        is_stated: whether the noise of the other values is stated.
        causes: projected derivatives with respect to the unknowns of every cause at size 1.
    """

    y: Float64[Tensor, " values"]
    covariance: Float64[Tensor, "values values"]
    exact: Float64[Tensor, "values _exact"]
    is_stated: bool
    causes: Mapping[str, Float64[Tensor, "values _unknowns"]] = field(repr=False)

    @staticmethod
    def from_fit(
        y: Float64[Tensor, " values"],
        fitted: Float64[Tensor, "values unknowns"],
        known: Float64[Tensor, "values directions"],
        exact: Bool[Tensor, " values"],
        is_stated: bool,
        causes: Mapping[str, Float64[Tensor, "values _columns"]],
    ) -> "FitResiduals":
        """Return the residuals with the fitted unknowns projected out.

        Args:
            y: residuals in units of the stated noise.
            fitted: derivatives with respect to the fitted unknowns.
            known: root of the covariance of the residuals due to quantities known with a stated uncertainty.
            exact: values whose noise is exactly as stated.
            is_stated: whether the noise of the other values is stated.
            causes: derivatives with respect to the unknowns of every cause at size 1.
        """
        U = orthonormal_columns(fitted)
        N = torch.linalg.qr(U, mode="complete")[0][:, U.shape[1] :].t()
        A = N @ known
        columns = {name: compressed_columns(N @ Z) for name, Z in causes.items()}
        return FitResiduals(N @ y, A @ A.t(), N[:, exact], is_stated, columns)

    def compare(self) -> tuple[Cause, ...]:
        """Return all causes: first those that are `named` because they are clear, then the others by Bayes factor."""
        alone = self._compared()
        named, here = set[str](), self
        while len(named) < _MAX_CAUSES:
            others = [one for one in here._compared() if one.name not in named]
            best = max(others, key=lambda one: one.log_bayes_factor, default=None)
            if best is None or best.log_bayes_factor < CLEAR:
                break
            named.add(best.name)
            Z = best.size * self.causes[best.name]
            here = replace(here, covariance=here.covariance + Z @ Z.t())
        causes = [replace(one, named=one.name in named) for one in alone]
        return tuple(sorted(causes, key=lambda one: (not one.named, -one.log_bayes_factor)))

    def _compared(self) -> list[Cause]:
        """Compare all causes one by one."""
        evidence = torch.empty(len(_NOISE), dtype=torch.float64)
        gains = {name: torch.empty(len(_NOISE), len(_SIZES), dtype=torch.float64) for name in self.causes}
        for row, factor in enumerate(_NOISE.tolist()):
            L = covariance_factor(self._total(factor))
            a = torch.linalg.solve_triangular(L, self.y[:, None], upper=False)[:, 0]
            evidence[row] = -0.5 * a.square().sum() - L.diagonal().log().sum()
            if self.is_stated:
                evidence[row] -= 0.5 * (math.log(factor) / _STATED_SPREAD) ** 2
            for name, Z in self.causes.items():
                W = torch.linalg.solve_triangular(L, Z, upper=False)
                gains[name][row] = evidence_gains(_SIZES, *evidence_coordinates(W, a))
        nothing = float(evidence.logsumexp(0))
        causes = []
        for name, gain in gains.items():
            joint = evidence[:, None] + gain
            factor, size = divmod(int(joint.argmax()), len(_SIZES))
            value = float(joint.logsumexp((0, 1))) - math.log(len(_SIZES)) - nothing
            share = self._share(name, float(_SIZES[size]), float(_NOISE[factor]))
            causes.append(Cause(name, value, float(_SIZES[size]), share))
        return causes

    def _total(self, factor: float) -> Float64[Tensor, "values values"]:
        """Return the covariance with the noise of a factor, which values with exact noise do not have."""
        total = self.covariance + (1 - factor**2) * self.exact @ self.exact.t()
        total.diagonal().add_(factor**2)
        return total

    def _share(self, name: str, size: float, factor: float) -> float:
        """Return the share of the squared residuals that the most probable unknowns of a cause explain."""
        Z = size * self.causes[name]
        part = Z @ Z.t()
        explained = part @ torch.linalg.solve(self._total(factor) + part, self.y)
        left = (self.y - explained).square().sum()
        return 1 - float(left / self.y.square().sum().clamp(min=1e-300))

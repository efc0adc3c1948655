"""Detect configurations with wrong measurements by the evidence of all rows, while unknowns may have drifted."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.cholesky import covariance_cholesky
from pisigma.estimation.drift import LinearValues, evidence_gains

_FACTORS = torch.logspace(0.5, 4.5, 17, dtype=torch.float64)
"""Factors on the noise that are tried for a wrong configuration."""
_MAX_SUSPECTS = 3
_MIN_GAIN = 2.0
"""Smallest gain of log evidence [nats] of a suspect configuration while everything else is unchanged."""
_MAX_WRONG_SHARE = 0.25
"""Largest share of wrong configurations; if four configurations disagree, it is unknown which one is wrong."""


What = TypeVar("What")


@dataclass(frozen=True, eq=False)
class ExplainedRows(Generic[What]):
    """The best explanation of measured values.

    Attributes:
        explanation: the explanation of the values.
        values: the measured values; those of wrong configurations have larger noise.
        log_evidence: log evidence of the values, including the prior odds of the explanation.
        covariance: covariance of the values.
        sigma: standard deviation of the noise of every value.
    """

    explanation: What
    values: LinearValues
    log_evidence: float
    covariance: Float64[Tensor, "values values"]
    sigma: Float64[Tensor, " values"]


def mark_wrong_rows(
    explained: ExplainedRows[What], explain: Callable[[Mapping[int, float]], ExplainedRows[What]]
) -> ExplainedRows[What]:
    """Mark configurations as wrong as long as this raises the log evidence by more than the prior penalty.

    If a drift of many unknowns is estimated from all rows, a wrong row is hard to detect. Therefore the most suspicious
    configurations get larger noise one at a time, and the drift is re-estimated for each of them; compare the
    externally studentised residuals of Cook and Weisberg 1982, Residuals and Influence in Regression, section 2.2.

    Args:
        explained: explanation of the values, with the wrong configurations found so far.
        explain: function that returns the best explanation for given wrong configurations, see `LinearValues`.

    Returns:
        The best explanation.
    """
    configurations = len(torch.unique(explained.values.configuration))
    while len(explained.values.wrong_configurations) + 1 <= _MAX_WRONG_SHARE * configurations:
        tried = [explain(wrong) for wrong in _suspects(explained)]
        best = max(tried, key=lambda one: one.log_evidence, default=explained)
        if best.log_evidence <= explained.log_evidence:
            break
        explained = best
    return explained


def _suspects(explained: ExplainedRows[What]) -> list[dict[int, float]]:
    """Return, for each of the most suspicious configurations, the known wrong configurations plus this one.

    Adding a variance `f² σ²` to the values of a configuration raises the log evidence like a drift along their unit
    vectors, see `DriftSearch`; in the metric of all values these are `V^-1` of the configuration.
    """
    values = explained.values
    inverse = torch.cholesky_inverse(covariance_cholesky(explained.covariance))
    a = inverse @ values.y
    tried: list[tuple[float, int, float]] = []
    for number in torch.unique(values.configuration).tolist():
        chosen = (values.configuration == number) & ~values.has_exact_noise
        if number in values.wrong_configurations or not bool(chosen.any()):
            continue
        sigma = explained.sigma[chosen]
        # The block of V^-1 is the precision of these values given all others, as if they were held out.
        eigenvalues, U = torch.linalg.eigh(inverse[chosen][:, chosen] * sigma * sigma[:, None])
        squares = (U.t() @ (a[chosen] * sigma)).square() / eigenvalues.clamp(min=1e-300)
        raised = evidence_gains(_FACTORS, eigenvalues.clamp(min=0.0), squares)
        best = int(raised.argmax())
        if float(raised[best]) > _MIN_GAIN:
            tried.append((float(raised[best]), number, float(_FACTORS[best])))
    if len(tried) == len(torch.unique(values.configuration)):
        return []  # an explanation that does not fit any row is itself wrong
    tried = sorted(tried, reverse=True)[:_MAX_SUSPECTS]
    return [{**values.wrong_configurations, number: factor} for _, number, factor in tried]

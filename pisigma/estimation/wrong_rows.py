"""Configurations that were measured wrongly, by the evidence of all other rows and beside whatever has drifted."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.cholesky import covariance_factor
from pisigma.estimation.drift import LinearValues, gains

FACTORS = torch.logspace(0.5, 4.5, 17, dtype=torch.float64)
"""Factors on the noise of a wrong configuration that are tried."""
SUSPECTS = 3
NOTEWORTHY = 2.0
"""[nats] Configurations that gain less while everything else stays as it is are no suspects."""
LARGEST_SHARE = 0.25
"""No more of the configurations are taken for wrong: of four that disagree nobody knows which is."""


What = TypeVar("What")


@dataclass(frozen=True, eq=False)
class Explained(Generic[What]):
    """The best explanation of some values.

    Attributes:
        what: the explanation.
        values: those of wrong configurations with a larger noise.
        log_evidence: of the values, with the prior odds of all that the explanation is made of.
        covariance: of the values.
        deviation: of the noise of every value.
    """

    what: What
    values: LinearValues
    log_evidence: float
    covariance: Float64[Tensor, "values values"]
    deviation: Float64[Tensor, " values"]


def with_wrong_rows(
    explained: Explained[What], explain: Callable[[Mapping[int, float]], Explained[What]]
) -> Explained[What]:
    """Take configurations for wrong as long as that raises the evidence by what it is worth.

    Beside a drift of many unknowns that was estimated from all rows, a wrong one looks usual. So those that stand out
    most get a noise of their own, one by one, and the drift is estimated anew for each; compare the externally
    studentised residuals of Cook and Weisberg 1982, Residuals and Influence in Regression, section 2.2.

    Args:
        explained: the values, some of which may count less already.
        explain: gives the best explanation for other wrong configurations, see `LinearValues`.

    Returns:
        The best explanation.
    """
    configurations = len(torch.unique(explained.values.configuration))
    while len(explained.values.wrong) + 1 <= LARGEST_SHARE * configurations:
        tried = [explain(wrong) for wrong in _suspects(explained)]
        best = max(tried, key=lambda one: one.log_evidence, default=explained)
        if best.log_evidence <= explained.log_evidence:
            break
        explained = best
    return explained


def _suspects(explained: Explained[What]) -> list[dict[int, float]]:
    """The wrong configurations and one more, each of those that gain most by a noise of its own.

    A variance `f² σ²` that is added to the values of a configuration raises the log evidence as one along their
    unit vectors does, see `DriftSearch`; in the metric of all values these are `V^-1` of the configuration.
    """
    values = explained.values
    inverse = torch.cholesky_inverse(covariance_factor(explained.covariance))
    a = inverse @ values.y
    tried: list[tuple[float, int, float]] = []
    for number in torch.unique(values.configuration).tolist():
        chosen = (values.configuration == number) & ~values.exact
        if number in values.wrong or not bool(chosen.any()):
            continue
        sigma = explained.deviation[chosen]
        eigenvalues, U = torch.linalg.eigh(inverse[chosen][:, chosen] * sigma * sigma[:, None])
        squares = (U.t() @ (a[chosen] * sigma)).square() / eigenvalues.clamp(min=1e-300)
        raised = gains(FACTORS, eigenvalues.clamp(min=0.0), squares)
        best = int(raised.argmax())
        if float(raised[best]) > NOTEWORTHY:
            tried.append((float(raised[best]), number, float(FACTORS[best])))
    if len(tried) == len(torch.unique(values.configuration)):
        return []  # what explains no row at all is wrong itself
    tried = sorted(tried, reverse=True)[:SUSPECTS]
    return [{**values.wrong, number: factor} for _, number, factor in tried]

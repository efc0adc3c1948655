"""What moved before a session, by the evidence of its rows: one hypothesis for everything that can move by itself."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.cholesky import covariance_factor
from pisigma.estimation.drift import (
    NOISE_FACTORS,
    NOISE_SPREAD,
    SIZES,
    DriftGroup,
    LinearValues,
    coordinates,
    fewest_columns,
    gains,
)

TRIED = SIZES[SIZES >= 1e-4]
"""Sizes of a motion, all equally probable: 0.1 mm to 0.3 m, 0.006 to 18 deg."""
CERTAIN = 0.01
"""Probability of "nothing (more) moved" below which something did."""
NAMED = 0.8
"""Probability from which on a motion is said to have happened."""
MOST_MOVED = 3


@dataclass(frozen=True, eq=False)
class Motion:
    """One hypothesis: what moved, and its probability.

    Attributes:
        group: the unknowns.
        size: of the motion that is most probable, see `DriftGroup`.
        probability: against nothing (more) and all other hypotheses.
    """

    group: DriftGroup
    size: float
    probability: float


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the hypotheses say of a session.

    Attributes:
        motions: that happened, the clearest first.
        candidates: where something moved and it is not clear what, all hypotheses, the most probable first; else none.
        unchanged: probability that nothing moved.
        noise_factor: most probable factor on the usual noise.
        log_evidence: of the rows, over all hypotheses beside the motions, and less what wrong rows are worth.
    """

    motions: tuple[Motion, ...]
    candidates: tuple[Motion, ...]
    unchanged: float
    noise_factor: float
    log_evidence: float


class SessionEvidence:
    """The evidence of a session's rows under a model's posterior, for everything that can have moved.

    The values are normal with the covariance `V = A A^T + B B^T + (f σ)²`: A are their derivatives by the directions
    of the posterior's root, so that geometry, frames and correction are as uncertain as the model knows them, and B
    those by what stands anywhere, such as the base of a tracker that was carried away. A hypothesis adds `s² Z Z^T` for
    its unknowns; its evidence is the mean over sizes s and noise factors f, each in closed form (see
    `pisigma.estimation.drift.DriftSearch`). Bayes factors times prior odds give the probabilities (Kass
    and Raftery 1995, Bayes factors, J. Am. Stat. Assoc. 90(430)).
    """

    def __init__(
        self,
        values: LinearValues,
        root: Float64[Tensor, "unknowns directions"],
        standing: Sequence[DriftGroup],
        hypotheses: Sequence[DriftGroup],
        usual_noise: Float64[Tensor, " sensors"],
    ) -> None:
        """Work out the covariance of the values where nothing moved.

        Args:
            values: rows of the session.
            root: of the covariance of the unknowns by the model's posterior.
            standing: what stands anywhere.
            hypotheses: what can have moved by itself, each with its prior odds.
            usual_noise: that of the calibration, per sensor.
        """
        self.values, self._usual_noise = values, usual_noise
        self.known = values.X @ root
        self._K = self.known @ self.known.t()
        for B in (values.X[:, one.index] * one.deviation for one in standing):
            self._K += B @ B.t()
        self._sigma = values.deviation(usual_noise)
        self._scaled = ~values.exact
        self._groups = tuple(hypotheses)
        self._Z = [fewest_columns(values.X[:, one.index] * one.scale) for one in self._groups]

    def with_wrong(self, wrong: Mapping[int, float]) -> "SessionEvidence":
        """Give the evidence of the same rows with other wrong configurations, see `LinearValues`."""
        other = copy(self)
        other.values = replace(self.values, wrong=wrong)
        other._sigma = other.values.deviation(self._usual_noise)
        return other

    def beside(self, groups: Sequence[DriftGroup]) -> "SessionEvidence":
        """Give the evidence of the same rows where some groups have moved by about their sizes, whatever else has."""
        other = copy(self)
        for one in groups:
            B = self.values.X[:, one.index] * one.deviation
            other._K = other._K + B @ B.t()
        return other

    def explain(self) -> Explanation:
        """Compare all hypotheses, and again beside what has moved clearly, until nothing more has."""
        motions: list[Motion] = []
        unchanged = 1.0
        while True:
            compared = self._compare(motions)
            unchanged = unchanged if motions else compared.unchanged
            clear, best = compared.unchanged < CERTAIN, compared.candidates[0]
            named = best.probability >= NAMED and best.group.single
            if not (clear and named) or len(motions) == MOST_MOVED:
                candidates = compared.candidates if clear and not motions else ()
                return replace(compared, unchanged=unchanged, candidates=candidates)
            motions.append(best)

    def shift(
        self, groups: Sequence[DriftGroup], noise_factor: float
    ) -> tuple[Float64[Tensor, " members"], Float64[Tensor, "members members"]]:
        """Estimate how far the unknowns of some groups have moved, everything else being as the model knows it.

        Args:
            groups: with the sizes of their priors; those that stand elsewhere may be among them.
            noise_factor: on the usual noise.

        Returns:
            The shifts [m or rad] and their covariance.
        """
        gain, covariance = self._gain(groups, noise_factor)
        return gain @ self.values.y, covariance

    def influence(
        self, groups: Sequence[DriftGroup], noise_factor: float
    ) -> tuple[Float64[Tensor, "members directions"], Float64[Tensor, "members members"]]:
        """Say where the error of an estimate by `shift` comes from if nothing has moved.

        Returns:
            Its derivative by the directions of the posterior's root, which sessions have in common; and the covariance
            of the rest, which is each session's own.
        """
        gain, _ = self._gain(groups, noise_factor)
        own = self._K - self.known @ self.known.t() + self._noise(noise_factor).square().diag()
        return gain @ self.known, gain @ own @ gain.t()

    def covariance(
        self, groups: Sequence[DriftGroup], noise_factor: float
    ) -> Float64[Tensor, "values values"]:
        """Give the covariance of the values where some groups have moved by about their sizes."""
        return self.beside(groups)._K + self._noise(noise_factor).square().diag()

    def error_score(self) -> float:
        """Root mean square of all values over their standard deviations where nothing moved; about 1 is usual."""
        factor = covariance_factor(self._K + self._noise(1.0).square().diag())
        a = torch.linalg.solve_triangular(factor, self.values.y[:, None], upper=False)
        return float(a.square().mean().sqrt())

    def _compare(self, motions: Sequence[Motion]) -> Explanation:
        """Compare all hypotheses beside some motions, and that nothing more has moved."""
        K = self._K
        for one in motions:
            Z = self._Z[self._groups.index(one.group)]
            K = K + one.size**2 * Z @ Z.t()
        evidence = torch.empty(len(NOISE_FACTORS), dtype=torch.float64)
        raised = torch.empty(len(NOISE_FACTORS), len(self._groups), len(TRIED), dtype=torch.float64)
        columns = torch.cat([self.values.y[:, None], *self._Z], 1)
        for row, noise_factor in enumerate(NOISE_FACTORS.tolist()):
            factor = covariance_factor(K + self._noise(noise_factor).square().diag())
            whitened = torch.linalg.solve_triangular(factor, columns, upper=False)
            evidence[row] = -0.5 * whitened[:, 0].square().sum() - factor.diagonal().log().sum()
            evidence[row] -= 0.5 * (math.log(noise_factor) / NOISE_SPREAD) ** 2
            raised[row] = self._raised(whitened[:, 0], whitened[:, 1:])
        joint = evidence[:, None, None] + raised
        nothing = evidence.logsumexp(0)
        log_odds = joint.logsumexp((0, 2)) - math.log(len(TRIED)) - nothing
        log_odds -= torch.tensor([group.worth for group in self._groups], dtype=torch.float64)
        log_odds[[self._groups.index(one.group) for one in motions]] = -math.inf
        log_odds = torch.cat([log_odds, log_odds.new_zeros(1)])
        *probability, unchanged = log_odds.softmax(0).tolist()
        sizes = TRIED[joint.logsumexp(0).argmax(1)].tolist()
        compared = [Motion(*one) for one in zip(self._groups, sizes, probability, strict=True)]
        likely = evidence if unchanged >= CERTAIN else joint.logsumexp((1, 2))
        return Explanation(
            motions=tuple(motions),
            candidates=tuple(sorted(compared, key=lambda one: -one.probability)),
            unchanged=unchanged,
            noise_factor=float(NOISE_FACTORS[likely.argmax()]),
            log_evidence=float(nothing + log_odds.logsumexp(0))
            - sum(one.group.worth for one in motions)
            - self.values.worth,
        )

    def _raised(self, a: Tensor, W: Tensor) -> Float64[Tensor, "groups sizes"]:
        """By how much every group of every size raises the log evidence; columns in the metric of everything else."""
        raised = torch.empty(len(self._groups), len(TRIED), dtype=torch.float64)
        widths = torch.tensor([Z.shape[1] for Z in self._Z])
        single = widths == 1
        columns = W[:, single.repeat_interleave(widths)]
        eigenvalues = columns.square().sum(0)
        squares = (columns.t() @ a).square() / eigenvalues.clamp(min=1e-300)
        raised[single] = gains(TRIED[:, None], eigenvalues[:, None], squares[:, None]).t()
        blocks = torch.split(W, widths.tolist(), 1)
        for number in (~single).nonzero()[:, 0].tolist():
            raised[number] = gains(TRIED, *coordinates(blocks[number], a))
        return raised

    def _noise(self, noise_factor: float) -> Float64[Tensor, " values"]:
        """Standard deviation of every value; what is exactly stated has no factor."""
        return torch.where(self._scaled, noise_factor * self._sigma, self._sigma)

    def _gain(self, groups: Sequence[DriftGroup], noise_factor: float) -> tuple[Tensor, Tensor]:
        """What an estimate of the unknowns of groups is by the values, and its covariance."""
        V = self._K + self._noise(noise_factor).square().diag()
        for B in (self.values.X[:, one.index] * one.deviation for one in groups if one.stands):
            V = V - B @ B.t()
        factor = covariance_factor(V)
        index, deviation = (
            torch.cat([getattr(one, name) for one in groups]) for name in ("index", "deviation")
        )
        W = torch.linalg.solve_triangular(factor, self.values.X[:, index] * deviation, upper=False)
        normal = W.t() @ W
        normal.diagonal().add_(1.0)
        covariance = torch.linalg.inv(normal) * deviation * deviation[:, None]
        back = torch.linalg.solve_triangular(factor.t(), W, upper=True)
        return covariance / deviation @ back.t(), covariance

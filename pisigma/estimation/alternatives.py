"""Compare alternative explanations by their evidence: causes of residuals, and motions before a session."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.estimation.cholesky import covariance_cholesky, orthonormal_columns
from pisigma.estimation.drift import (
    NOISE_FACTORS,
    NOISE_SPREAD,
    SIZES,
    DriftGroup,
    LinearValues,
    compressed_columns,
    diagonalise_evidence,
    evidence_gains,
)

_SIZES = torch.logspace(-3, 1.5, 28, dtype=torch.float64)
"""Sizes of a cause relative to its scale, all equally probable."""
_NOISE = torch.logspace(-2, 2, 41, dtype=torch.float64)
"""Factors on the noise that are tried."""
_STATED_SPREAD = 0.3
"""Prior standard deviation of the logarithm of the factor on the noise if the noise is stated."""
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
        is_supported: whether the evidence supports the cause, because it is the clearest one, or clear in addition to
            clearer ones.
    """

    name: str
    log_bayes_factor: float
    size: float
    explained_share: float
    is_supported: bool = False


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
        covariance_without_noise: projected covariance due to quantities known with a stated uncertainty and due to
            included causes.
        exact_directions: projected unit vectors of the values whose noise is exactly as stated, such as that of a
            prior.
        is_stated: whether the noise of the other values is stated.
        causes: projected derivatives with respect to the unknowns of every cause at size 1.
    """

    y: Float64[Tensor, " values"]
    covariance_without_noise: Float64[Tensor, "values values"]
    exact_directions: Float64[Tensor, "values _exact"]
    is_stated: bool
    causes: Mapping[str, Float64[Tensor, "values _unknowns"]] = field(repr=False)

    @staticmethod
    def from_fit(
        y: Float64[Tensor, " values"],
        fitted_columns: Float64[Tensor, "values unknowns"],
        stated_covariance_root: Float64[Tensor, "values directions"],
        has_exact_noise: Bool[Tensor, " values"],
        has_stated_noise: bool,
        causes: Mapping[str, Float64[Tensor, "values _columns"]],
    ) -> "FitResiduals":
        """Return the residuals with the fitted unknowns projected out.

        Args:
            y: residuals in units of the stated noise.
            fitted_columns: derivatives with respect to the fitted unknowns.
            stated_covariance_root: root of the covariance of the residuals due to quantities known with a stated
                uncertainty.
            has_exact_noise: values whose noise is exactly as stated.
            has_stated_noise: whether the noise of the other values is stated.
            causes: derivatives with respect to the unknowns of every cause at size 1.
        """
        U = orthonormal_columns(fitted_columns)
        N = torch.linalg.qr(U, mode="complete")[0][:, U.shape[1] :].t()
        A = N @ stated_covariance_root
        columns = {name: compressed_columns(N @ Z) for name, Z in causes.items()}
        return FitResiduals(N @ y, A @ A.t(), N[:, has_exact_noise], has_stated_noise, columns)

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
            here = replace(here, covariance_without_noise=here.covariance_without_noise + Z @ Z.t())
        causes = [replace(one, is_supported=one.name in named) for one in alone]
        return tuple(sorted(causes, key=lambda one: (not one.is_supported, -one.log_bayes_factor)))

    def _compared(self) -> list[Cause]:
        """Compare all causes one by one."""
        evidence = torch.empty(len(_NOISE), dtype=torch.float64)
        gains = {name: torch.empty(len(_NOISE), len(_SIZES), dtype=torch.float64) for name in self.causes}
        for row, factor in enumerate(_NOISE.tolist()):
            L = covariance_cholesky(self._total(factor))
            a = torch.linalg.solve_triangular(L, self.y[:, None], upper=False)[:, 0]
            evidence[row] = -0.5 * a.square().sum() - L.diagonal().log().sum()
            if self.is_stated:
                evidence[row] -= 0.5 * (math.log(factor) / _STATED_SPREAD) ** 2
            for name, Z in self.causes.items():
                W = torch.linalg.solve_triangular(L, Z, upper=False)
                gains[name][row] = evidence_gains(_SIZES, *diagonalise_evidence(W, a))
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
        total = (
            self.covariance_without_noise
            + (1 - factor**2) * self.exact_directions @ self.exact_directions.t()
        )
        total.diagonal().add_(factor**2)
        return total

    def _share(self, name: str, size: float, factor: float) -> float:
        """Return the share of the squared residuals that a cause with its most probable values explains."""
        Z = size * self.causes[name]
        part = Z @ Z.t()
        explained = part @ torch.linalg.solve(self._total(factor) + part, self.y)
        left = (self.y - explained).square().sum()
        return 1 - float(left / self.y.square().sum().clamp(min=1e-300))


_TRIED = SIZES[SIZES >= 1e-4]
"""Sizes of a motion that are tried, all equally probable: 0.1 mm to 0.3 m, 0.006 to 18 deg."""
_CERTAIN = 0.01
"""Probability of "nothing (else) moved" below which something certainly moved."""
_NAMED = 0.8
"""Probability above which a motion is reported as having happened."""
_MAX_MOTIONS = 3


@dataclass(frozen=True, eq=False)
class GroupMotion:
    """A hypothesis that one group of unknowns moved, and its probability.

    Attributes:
        group: unknowns that moved.
        size: most probable size of the motion, see `DriftGroup`.
        probability: posterior probability among all hypotheses, including that nothing (else) moved.
    """

    group: DriftGroup
    size: float
    probability: float


@dataclass(frozen=True, eq=False)
class Explanation:
    """Posterior of the hypotheses for a session.

    Attributes:
        motions: motions that certainly happened, most probable first.
        candidates: all hypotheses, most probable first, if something moved but it is unclear what; otherwise empty.
        unchanged_probability: probability that no part moved.
        noise_factor: most probable factor on the usual noise.
        log_evidence: log evidence of the rows given the motions, averaged over all other hypotheses, minus the prior
            penalties of the motions and of wrong rows.
    """

    motions: tuple[GroupMotion, ...]
    candidates: tuple[GroupMotion, ...]
    unchanged_probability: float
    noise_factor: float
    log_evidence: float


class SessionEvidence:
    """Evidence of a session's rows under a model's posterior, for all hypotheses about what moved.

    The values are normal with the covariance `V = A A^T + B B^T + (f σ)²`. A contains the derivatives along the
    columns of the posterior's root, so geometry, frames and correction have the uncertainty of the model; B contains
    the derivatives with respect to unknowns with a wide prior, such as the base of a tracker that was relocated. A
    hypothesis adds `s² Z Z^T` for its unknowns; its evidence is the mean over sizes s and noise factors f, each in
    closed form (see `pisigma.estimation.drift.DriftSearch`). Bayes factors times prior odds give the probabilities
    (Kass and Raftery 1995, Bayes factors, J. Am. Stat. Assoc. 90(430)).
    """

    def __init__(
        self,
        values: LinearValues,
        root: Float64[Tensor, "unknowns directions"],
        standing: Sequence[DriftGroup],
        hypotheses: Sequence[DriftGroup],
        usual_noise: Float64[Tensor, " sensors"],
    ) -> None:
        """Compute the covariance of the values if nothing moved.

        Args:
            values: values of the session.
            root: covariance root of the unknowns in the model's posterior.
            standing: groups with a wide prior, such as relocated frames.
            hypotheses: groups that may have moved independently, with their prior odds.
            usual_noise: noise of the calibration for every sensor.
        """
        self.values, self._usual_noise = values, usual_noise
        self.known = values.X @ root
        self._K = self.known @ self.known.t()
        for B in (values.X[:, one.index] * one.sigma for one in standing):
            self._K += B @ B.t()
        self._sigma = values.sigma(usual_noise)
        self._scaled = ~values.has_exact_noise
        self._groups = tuple(hypotheses)
        self._Z = [
            compressed_columns(values.X[:, one.index] * one.sigma_at_unit_size) for one in self._groups
        ]

    def with_wrong_configurations(self, wrong_configurations: Mapping[int, float]) -> "SessionEvidence":
        """Return the evidence with other `LinearValues.wrong_configurations`."""
        other = copy(self)
        other.values = replace(self.values, wrong_configurations=wrong_configurations)
        other._sigma = other.values.sigma(self._usual_noise)
        return other

    def with_moved_groups(self, groups: Sequence[DriftGroup]) -> "SessionEvidence":
        """Return the evidence of the same rows if groups have moved, with their sizes as standard deviations."""
        other = copy(self)
        for one in groups:
            B = self.values.X[:, one.index] * one.sigma
            other._K = other._K + B @ B.t()
        return other

    def compare_hypotheses(self) -> Explanation:
        """Compare all hypotheses, and repeat with each clear motion added until nothing else has moved."""
        motions: list[GroupMotion] = []
        unchanged = 1.0
        while True:
            compared = self._compare(motions)
            unchanged = unchanged if motions else compared.unchanged_probability
            clear, best = compared.unchanged_probability < _CERTAIN, compared.candidates[0]
            named = best.probability >= _NAMED and best.group.is_one_motion
            if not (clear and named) or len(motions) == _MAX_MOTIONS:
                candidates = compared.candidates if clear and not motions else ()
                return replace(compared, unchanged_probability=unchanged, candidates=candidates)
            motions.append(best)

    def estimate_shift(
        self, groups: Sequence[DriftGroup], noise_factor: float
    ) -> tuple[Float64[Tensor, " members"], Float64[Tensor, "members members"]]:
        """Estimate how far the unknowns of the given groups have moved; all others have the uncertainty of the model.

        Args:
            groups: groups with the sizes of their priors; they may include relocated frames.
            noise_factor: factor on the usual noise.

        Returns:
            The shifts [m or rad] and their covariance.
        """
        gain, covariance = self._gain(groups, noise_factor)
        return gain @ self.values.y, covariance

    def sensitivity_and_covariance(
        self, groups: Sequence[DriftGroup], noise_factor: float
    ) -> tuple[Float64[Tensor, "members directions"], Float64[Tensor, "members members"]]:
        """Return the sources of error of an estimate of `estimate_shift` if nothing has moved.

        Returns:
            The derivative of the estimate along the columns of the posterior's root, which describes an error that
            sessions have in common, and the covariance of the other errors, which are independent between sessions.
        """
        gain, _ = self._gain(groups, noise_factor)
        own = self._K - self.known @ self.known.t() + self._noise(noise_factor).square().diag()
        return gain @ self.known, gain @ own @ gain.t()

    def covariance(
        self, groups: Sequence[DriftGroup], noise_factor: float
    ) -> Float64[Tensor, "values values"]:
        """Return the covariance of the values if groups have moved, with their sizes as standard deviations."""
        return self.with_moved_groups(groups)._K + self._noise(noise_factor).square().diag()

    def error_score(self) -> float:
        """Return the RMS of the values divided by their standard deviations if nothing moved; usually about 1."""
        factor = covariance_cholesky(self._K + self._noise(1.0).square().diag())
        a = torch.linalg.solve_triangular(factor, self.values.y[:, None], upper=False)
        return float(a.square().mean().sqrt())

    def _compare(self, motions: Sequence[GroupMotion]) -> Explanation:
        """Compare all hypotheses given some motions, including that nothing else has moved."""
        K = self._K
        for one in motions:
            Z = self._Z[self._groups.index(one.group)]
            K = K + one.size**2 * Z @ Z.t()
        evidence = torch.empty(len(NOISE_FACTORS), dtype=torch.float64)
        raised = torch.empty(len(NOISE_FACTORS), len(self._groups), len(_TRIED), dtype=torch.float64)
        # One triangular solve per noise factor whitens values and all hypotheses at once.
        columns = torch.cat([self.values.y[:, None], *self._Z], 1)
        for row, noise_factor in enumerate(NOISE_FACTORS.tolist()):
            factor = covariance_cholesky(K + self._noise(noise_factor).square().diag())
            whitened = torch.linalg.solve_triangular(factor, columns, upper=False)
            evidence[row] = -0.5 * whitened[:, 0].square().sum() - factor.diagonal().log().sum()
            # Log-normal prior of the noise factor: few sessions have noise far from that of the calibration.
            evidence[row] -= 0.5 * (math.log(noise_factor) / NOISE_SPREAD) ** 2
            raised[row] = self._raised(whitened[:, 0], whitened[:, 1:])
        joint = evidence[:, None, None] + raised
        nothing = evidence.logsumexp(0)
        # Average over noise factors and sizes, because a hypothesis must not win by a size chosen afterwards.
        log_odds = joint.logsumexp((0, 2)) - math.log(len(_TRIED)) - nothing
        log_odds -= torch.tensor([group.log_prior_penalty for group in self._groups], dtype=torch.float64)
        # Groups that are known to have moved are no longer hypotheses.
        log_odds[[self._groups.index(one.group) for one in motions]] = -math.inf
        log_odds = torch.cat([log_odds, log_odds.new_zeros(1)])
        *probability, unchanged = log_odds.softmax(0).tolist()
        sizes = _TRIED[joint.logsumexp(0).argmax(1)].tolist()
        compared = [GroupMotion(*one) for one in zip(self._groups, sizes, probability, strict=True)]
        # noise factor of the explanation: without further motion if none is needed, otherwise with all of them
        likely = evidence if unchanged >= _CERTAIN else joint.logsumexp((1, 2))
        return Explanation(
            motions=tuple(motions),
            candidates=tuple(sorted(compared, key=lambda one: -one.probability)),
            unchanged_probability=unchanged,
            noise_factor=float(NOISE_FACTORS[likely.argmax()]),
            log_evidence=float(nothing + log_odds.logsumexp(0))
            - sum(one.group.log_prior_penalty for one in motions)
            - self.values.log_prior_penalty,
        )

    def _raised(self, a: Tensor, W: Tensor) -> Float64[Tensor, "groups sizes"]:
        """Return the gain of log evidence for every group and size."""
        raised = torch.empty(len(self._groups), len(_TRIED), dtype=torch.float64)
        widths = torch.tensor([Z.shape[1] for Z in self._Z])
        # Groups of one unknown are all evaluated in one product; the others need one eigendecomposition each.
        single = widths == 1
        columns = W[:, single.repeat_interleave(widths)]
        eigenvalues = columns.square().sum(0)
        squares = (columns.t() @ a).square() / eigenvalues.clamp(min=1e-300)
        raised[single] = evidence_gains(_TRIED[:, None], eigenvalues[:, None], squares[:, None]).t()
        blocks = torch.split(W, widths.tolist(), 1)
        for number in (~single).nonzero()[:, 0].tolist():
            raised[number] = evidence_gains(_TRIED, *diagonalise_evidence(blocks[number], a))
        return raised

    def _noise(self, noise_factor: float) -> Float64[Tensor, " values"]:
        """Return the standard deviation of every value; values that are stated as exact have no factor."""
        return torch.where(self._scaled, noise_factor * self._sigma, self._sigma)

    def _gain(self, groups: Sequence[DriftGroup], noise_factor: float) -> tuple[Tensor, Tensor]:
        """Return the gain matrix from values to an estimate of the groups' unknowns, and its covariance."""
        # Groups of fixed size are part of K, but those to be estimated must not also be treated as noise.
        V = self._K + self._noise(noise_factor).square().diag()
        for B in (self.values.X[:, one.index] * one.sigma for one in groups if one.fixed_size):
            V = V - B @ B.t()
        # Given the other variances, the estimate is a ridge regression with unit prior in units of `sigma`.
        factor = covariance_cholesky(V)
        index, deviation = (torch.cat([getattr(one, name) for one in groups]) for name in ("index", "sigma"))
        W = torch.linalg.solve_triangular(factor, self.values.X[:, index] * deviation, upper=False)
        normal = W.t() @ W
        normal.diagonal().add_(1.0)
        covariance = torch.linalg.inv(normal) * deviation * deviation[:, None]
        back = torch.linalg.solve_triangular(factor.t(), W, upper=True)
        return covariance / deviation @ back.t(), covariance

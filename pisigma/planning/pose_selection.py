"""Select the poses to measure from many candidates so that the remaining uncertainty is minimal."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.estimation.covariance_root import multiply_updated_root
from pisigma.files.errors import Phrase, PlanningError
from pisigma.planning.plan_settings import Criterion

DROPPED_VARIANCE = 1e-10
"""Largest share of the task's variance in directions that are dropped. If a base may be anywhere within a metre, the
errors of a tenth of a millimetre for which a plan is made are 1e-8 of the variance."""
_MAX_EXCHANGED = 400
"""Number of candidates that take part in the exchange: the selected ones, and the best of the others."""
_MIN_GAIN = 1e-6
"""Gain below which candidates are not exchanged [nats, or share of the variance]."""
_MIN_REMAINING = 1e-3
"""Remaining share of a value's standard deviation below which the removal of a pose would lose all numerical
accuracy."""
_MAX_PASSES = 3
"""Largest number of passes over the selected poses in the exchange."""


def select_poses(
    candidate_derivatives: Float64[Tensor, "candidates values directions"],
    task_derivatives: Float64[Tensor, "tasks 3 directions"],
    count: int,
    criterion: Criterion = "I",
) -> Int64[Tensor, " count"]:
    """Select poses to measure, the most useful first.

    "D" (D-optimal) maximises the information on all unknowns, `log det(1 + Σ B_i^T B_i)`; "I" (I-optimal) minimises the
    mean variance of the tool's position over the task, `tr(C W)`. Poses are first added one by one, each time the best
    pose by D given the previous poses, as in a pivoted block Cholesky factorisation of the covariance of all values.
    Then every pose is exchanged for the best other candidate as long as the criterion improves; for I, this is started
    both from the greedy selection and from the result for D, and the better result is used. The selected poses are
    sorted by the criterion, so that the first n poses are a good selection of n poses.

    Source: exchange of Fedorov 1972, "Theory of Optimal Experiments", section 3.3; greedy selection of Krause, Singh
    and Guestrin 2008, JMLR 9, 235-284; for robots Borm and Menq 1991 select poses by observability.

    Args:
        candidate_derivatives: derivatives B of the measured values of the candidates under the prior; see
            `RobotPosterior.sensitivities`.
        task_derivatives: derivatives D of the tool's position over the task under the prior; see
            `RobotPosterior.tool_derivatives`.
        count: number of poses to select.
        criterion: "D" or "I", see the description above.

    Returns:
        Indices of candidates, without repetition.

    Raises:
        PlanningError: there are fewer candidates than poses, or there is no task.
    """
    if not 1 <= count <= len(candidate_derivatives):
        raise PlanningError(
            expected=f"1 to {len(candidate_derivatives)} poses to select from {len(candidate_derivatives)} candidates",
            value=count,
            option="count",
            remedy="select fewer poses or draw more candidates",
        )
    if not len(task_derivatives):
        raise PlanningError(
            expected="joint values of the task",
            value=Phrase("none"),
            option="task",
            remedy="add poses to the task",
        )
    goal = condense_derivatives(task_derivatives)
    first = PoseSelection(candidate_derivatives, goal, "D")
    first.add_until(count)
    chosen = torch.tensor(first.chosen)
    remaining = (
        PoseSelection(candidate_derivatives, goal, criterion, first.chosen)
        .gains()
        .argsort(descending=True)[: len(candidate_derivatives) - count]
    )
    few = torch.cat([chosen, remaining[: max(_MAX_EXCHANGED - count, 0)]])
    choice = PoseSelection(candidate_derivatives[few], goal, "D", range(count))
    choice.exchange_candidates()
    if criterion == "I":
        both = [
            PoseSelection(candidate_derivatives[few], goal, "I", start)
            for start in (range(count), choice.chosen)
        ]
        for one in both:
            one.exchange_candidates()
        choice = min(both, key=lambda one: one.variance)
    chosen = few[torch.tensor(choice.chosen)]
    ordered = PoseSelection(candidate_derivatives[chosen], goal, criterion)
    ordered.add_until(count)
    result: Tensor = chosen[torch.tensor(ordered.chosen)]
    return result


def condense_derivatives(
    task_derivatives: Float64[Tensor, "tasks 3 directions"],
) -> Float64[Tensor, "rank directions"]:
    """Compute a few rows W with the same mean variance, `W^T W = mean(D_i^T D_i)`, up to `DROPPED_VARIANCE`."""
    values, vectors = torch.linalg.eigh(
        torch.einsum("tcd,tce->de", task_derivatives, task_derivatives) / len(task_derivatives)
    )
    left_out = values.clamp(min=0).cumsum(0)
    kept = left_out > DROPPED_VARIANCE * left_out[-1]
    rows: Tensor = values[kept].sqrt()[:, None] * vectors[:, kept].t()
    return rows


@dataclass(frozen=True, eq=False)
class _Change:
    """Effect of adding or removing a candidate.

    Attributes:
        sign: +1 to add it, -1 to remove it.
        half: root H of the change of the covariance, `C' = C - sign H^T H`.
        along: U = B H^T of every candidate.
        S: covariance of the values of every candidate after the change.
        P: `X X^T` of every candidate after the change, for I.
    """

    sign: float
    half: Float64[Tensor, "values directions"]
    along: Float64[Tensor, "candidates values values"]
    S: Float64[Tensor, "candidates values values"]
    P: Float64[Tensor, "candidates values values"]


class PoseSelection:
    """Selected candidates, and the gain of adding any other candidate.

    With C the covariance of the standard normal numbers given the selected poses, adding a pose changes it by
    `-C B_i^T (1 + B_i C B_i^T)^-1 B_i C`, and removing it by `+C B_i^T (1 - B_i C B_i^T)^-1 B_i C` (Woodbury).

    Attributes:
        chosen: indices of the selected candidates, in the order in which they were added.
    """

    def __init__(
        self,
        B: Float64[Tensor, "candidates values directions"],
        goal: Float64[Tensor, "rank directions"],
        criterion: Criterion,
        chosen: Sequence[int] = (),
    ) -> None:
        """Start with the given poses, or with none.

        Args:
            B: derivatives of the measured values, see `RobotPosterior.sensitivities`.
            goal: rows of the task, see `condense_derivatives`.
            criterion: see `select_poses`.
            chosen: indices of candidates that are already selected.
        """
        self.chosen = list(chosen)
        self._B, self._goal, self._criterion = B, goal, criterion
        self._update_all()

    @property
    def variance(self) -> float:
        """Mean variance of the tool's position over the task given the selected poses [m²]."""
        return float(((self._goal @ self._C) * self._goal).sum())

    def gains(self) -> Float64[Tensor, " candidates"]:
        """Compute the gain of every candidate: information [nats] for D, variance [m²] for I; -inf if selected."""
        return self._gains(self._S, self._P)

    def add_candidate(self, candidate_index: int) -> None:
        """Add a candidate to the selection."""
        change = self._change(candidate_index, 1.0)
        assert change is not None  # adding a candidate loses no numerical accuracy
        self._take(change)
        self.chosen.append(candidate_index)

    def add_until(self, count: int) -> None:
        """Add the best candidates until `count` are selected."""
        while len(self.chosen) < count:
            self.add_candidate(int(self.gains().argmax()))

    def exchange_candidates(self) -> None:
        """Exchange every selected candidate for the best other one until no exchange improves the criterion."""
        for _ in range(_MAX_PASSES if len(self.chosen) < len(self._B) else 0):
            exchanged = False
            for number in list(self.chosen):
                exchanged |= self._exchange(number)
            if not exchanged:
                break

    def _exchange(self, number: int) -> bool:
        """Exchange a selected candidate for the best other one, or put it last; return whether it was exchanged."""
        self.chosen.remove(number)
        without = self._change(number, -1.0)
        if without is None:
            self._update_all()
            gains = self.gains()
        else:
            gains = self._gains(without.S, without.P)
        best = int(gains.argmax())
        scale = 1.0 if self._criterion == "D" else float(gains[number])
        exchanged = float(gains[best] - gains[number]) > _MIN_GAIN * scale
        if without is not None and not exchanged:
            self.chosen.append(number)
            return False
        if without is not None:
            self._take(without)
        self.add_candidate(best if exchanged else number)
        return exchanged

    def _gains(self, S: Tensor, P: Tensor) -> Float64[Tensor, " candidates"]:
        lower = torch.linalg.cholesky(S + torch.eye(S.shape[1]).to(S))
        if self._criterion == "D":
            gains: Tensor = lower.diagonal(dim1=1, dim2=2).log().sum(1)
        else:
            gains = (torch.cholesky_inverse(lower) * P).sum((1, 2))
        gains[self.chosen] = -torch.inf
        return gains

    def _update_all(self) -> None:
        """Compute the covariance given the selected candidates from scratch."""
        rows = self._B[self.chosen].flatten(0, 1)
        information = torch.eye(rows.shape[1]).to(rows) + rows.t() @ rows
        self._C = torch.cholesky_inverse(torch.linalg.cholesky(information))
        # C is the covariance of the unknowns; S is the covariance of every candidate's values.
        along = self._B @ self._C
        self._S = along @ self._B.mT  # covariance of the values of every candidate
        self._X = along @ self._goal.t() if self._criterion == "I" else self._B[..., :0]  # with the task
        self._P = self._X @ self._X.mT

    def _change(self, number: int, sign: float) -> _Change | None:
        """Compute the effect of adding (+1) or removing (-1) a candidate; None if removal is numerically impossible."""
        G = self._C @ self._B[number].t()
        # Woodbury: a pose changes C by a matrix of rank k only, the number of its values.
        here = torch.eye(G.shape[1]).to(G) + sign * self._B[number] @ G
        lower, failed = torch.linalg.cholesky_ex(here)
        if sign < 0 and (int(failed) or float(lower.diagonal().min()) < _MIN_REMAINING):
            return None
        # contiguous by rows, because products with all candidates read it in this order
        half = torch.linalg.solve_triangular(lower, G.t(), upper=False).contiguous()
        U = self._B @ half.t()
        P = self._P
        # for an added candidate this would cancel, so `_take` computes it from X
        if self._criterion == "I" and sign < 0:
            task = half @ self._goal.t()
            cross = (self._X @ task.t()) @ U.mT
            P = P + cross + cross.mT + U @ (task @ task.t()) @ U.mT
        return _Change(sign, half, U, self._S - sign * U @ U.mT, P)

    def _take(self, change: _Change) -> None:
        """Apply a change to the selection."""
        half, U, self._S, self._P = change.half, change.along, change.S, change.P
        self._C -= change.sign * half.t() @ half
        if self._criterion == "I":
            self._X.flatten(0, 1).addmm_(U.flatten(0, 1), half @ self._goal.t(), alpha=-change.sign)
            if change.sign > 0:
                self._P = self._X @ self._X.mT


def complete_selection(
    candidate_derivatives: Float64[Tensor, "candidates values directions"],
    task_derivatives: Float64[Tensor, "tasks 3 directions"],
    kept: Int64[Tensor, " kept"],
    others: Int64[Tensor, " others"],
    count: int,
    criterion: Criterion = "I",
) -> Int64[Tensor, " count"]:
    """Add the most useful of the other candidates to a selection, and sort all of them; see `select_poses`.

    Args:
        candidate_derivatives: derivatives B of the measured values of the candidates under the prior.
        task_derivatives: derivatives D of the tool's position over the task under the prior.
        kept: indices of the candidates that are already selected.
        others: indices of the candidates to choose from.
        count: number of poses to select, including those already selected.
        criterion: "D" or "I".

    Returns:
        Indices of candidates, the most useful first.
    """
    if not len(kept):
        return others[select_poses(candidate_derivatives[others], task_derivatives, count, criterion)]
    if added := count - len(kept):
        # the value of a candidate is what it adds to the poses already selected, so the derivatives are taken
        # under their posterior
        measured = candidate_derivatives[kept].flatten(0, 1)
        after, task = (
            multiply_updated_root(candidate_derivatives[others], measured),
            multiply_updated_root(task_derivatives, measured),
        )
        kept = torch.cat([kept, others[select_poses(after, task, added, criterion)]])
    return kept[select_poses(candidate_derivatives[kept], task_derivatives, count, criterion)]

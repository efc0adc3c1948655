"""Which of many candidate poses to measure: those that leave least uncertain."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import PlanningError
from pisigma.planning.plan_settings import Criterion

LEAST_VARIANCE = 1e-10
"""Share of the task's variance that directions which are left out may hold together: where a base may stand anywhere
within a metre, errors of a tenth of a millimetre, which a plan is for, are 1e-8 of it."""
EXCHANGED = 400
"""So many of the candidates take part in the exchange: the chosen ones, and the best of the others."""
LEAST_GAIN = 1e-6
"""[nats or share of the variance] An exchange has to gain more."""
LEAST_LEFT = 1e-3
"""Where a pose leaves a smaller share of a value's standard deviation than this, taking it back loses all digits."""
PASSES = 3
"""Every chosen pose is exchanged so often at most."""


def choose(
    B: Float64[Tensor, "candidates values directions"],
    D: Float64[Tensor, "tasks 3 directions"],
    count: int,
    criterion: Criterion = "I",
) -> Int64[Tensor, " count"]:
    """Choose poses to measure, the most useful first.

    "D" maximises the information on all unknowns, `log det(1 + Σ B_i^T B_i)`; "I" minimises the mean variance of the
    tool's position over the task, `tr(C W)`. Poses are taken one after the other, each the best by D beside those
    before it: a pivoted block Cholesky factorisation of the covariance of all values. Then each is exchanged for the
    best other one as long as that gains something; for I from there and from where the exchange by D ends, of which
    the better end is taken. The chosen poses are put in order by the criterion, so that the first n of them are a good
    choice of n.

    Source: exchange of Fedorov 1972, "Theory of Optimal Experiments", section 3.3; greedy choice of Krause, Singh and
    Guestrin 2008, JMLR 9, 235-284; for robots Borm and Menq 1991 choose poses by observability.

    Args:
        B: of the candidates, before the first of them is measured; see `Knowledge.measured`.
        D: of the poses where the robot shall be accurate; see `Knowledge.tool`.
        count: how many to choose.
        criterion: see above.

    Returns:
        Numbers of candidates, each once at most.

    Raises:
        PlanningError: there are not as many candidates, or no task.
    """
    if not 1 <= count <= len(B):
        raise PlanningError(
            f"1 to {len(B)} poses can be chosen from {len(B)} candidates, {count} were wanted; ask "
            "for fewer or draw more candidates."
        )
    if not len(D):
        raise PlanningError("joint values of the task were wanted, got none; state some poses.")
    goal = condensed(D)
    first = Choice(B, goal, "D")
    first.grow(count)
    chosen = torch.tensor(first.chosen)
    remaining = Choice(B, goal, criterion, first.chosen).gains().argsort(descending=True)[: len(B) - count]
    few = torch.cat([chosen, remaining[: max(EXCHANGED - count, 0)]])
    choice = Choice(B[few], goal, "D", range(count))
    choice.exchange()
    if criterion == "I":
        both = [Choice(B[few], goal, "I", start) for start in (range(count), choice.chosen)]
        for one in both:
            one.exchange()
        choice = min(both, key=lambda one: one.variance)
    chosen = few[torch.tensor(choice.chosen)]
    ordered = Choice(B[chosen], goal, criterion)
    ordered.grow(count)
    result: Tensor = chosen[torch.tensor(ordered.chosen)]
    return result


def condensed(D: Float64[Tensor, "tasks 3 directions"]) -> Float64[Tensor, "rank directions"]:
    """Give few rows W with the same mean variance, `W^T W = mean(D_i^T D_i)`, but for `LEAST_VARIANCE` of it."""
    values, vectors = torch.linalg.eigh(torch.einsum("tcd,tce->de", D, D) / len(D))
    left_out = values.clamp(min=0).cumsum(0)
    kept = left_out > LEAST_VARIANCE * left_out[-1]
    rows: Tensor = values[kept].sqrt()[:, None] * vectors[:, kept].t()
    return rows


@dataclass(frozen=True, eq=False)
class _Change:
    """What a candidate more, or fewer, changes.

    Attributes:
        sign: +1 where it is added, -1 where it is taken back.
        half: root H of the covariance that goes or comes back, `C' = C - sign H^T H`.
        along: U = B H^T of every candidate.
        S: covariance of the values of every candidate afterwards.
        P: `X X^T` of every candidate afterwards, for I.
    """

    sign: float
    half: Float64[Tensor, "values directions"]
    along: Float64[Tensor, "candidates values values"]
    S: Float64[Tensor, "candidates values values"]
    P: Float64[Tensor, "candidates values values"]


class Choice:
    """Some of the candidates, and what every one of the others would add to them.

    With C the covariance of the standard normal numbers after the chosen poses, a pose changes it by
    `-C B_i^T (1 + B_i C B_i^T)^-1 B_i C`, and taking it back by `+C B_i^T (1 - B_i C B_i^T)^-1 B_i C` (Woodbury).

    Attributes:
        chosen: numbers of the chosen candidates, in the order in which they came.
    """

    def __init__(
        self,
        B: Float64[Tensor, "candidates values directions"],
        goal: Float64[Tensor, "rank directions"],
        criterion: Criterion,
        chosen: Sequence[int] = (),
    ) -> None:
        """Start with no pose, or with some.

        Args:
            B: see `Knowledge.measured`.
            goal: see `condensed`.
            criterion: see `choose`.
            chosen: numbers of candidates that are chosen already.
        """
        self.chosen = list(chosen)
        self._B, self._goal, self._criterion = B, goal, criterion
        self._update_all()

    @property
    def variance(self) -> float:
        """Mean variance of the tool's position over the task after the chosen poses [m²]."""
        return float(((self._goal @ self._C) * self._goal).sum())

    def gains(self) -> Float64[Tensor, " candidates"]:
        """What every candidate would gain: information [nats] for D, less variance [m²] for I; none for chosen ones."""
        return self._gains(self._S, self._P)

    def add(self, number: int) -> None:
        """Choose a candidate."""
        change = self._change(number, 1.0)
        assert change is not None  # adding loses no digits
        self._take(change)
        self.chosen.append(number)

    def grow(self, count: int) -> None:
        """Choose the best candidate until there are so many."""
        while len(self.chosen) < count:
            self.add(int(self.gains().argmax()))

    def exchange(self) -> None:
        """Exchange every chosen candidate for the best other one, until nothing gains any more."""
        for _ in range(PASSES if len(self.chosen) < len(self._B) else 0):
            exchanged = False
            for number in list(self.chosen):
                exchanged |= self._exchange(number)
            if not exchanged:
                break

    def _exchange(self, number: int) -> bool:
        """Exchange a chosen candidate for the best other one, or put it last; say whether it was exchanged."""
        self.chosen.remove(number)
        without = self._change(number, -1.0)
        if without is None:
            self._update_all()
            gains = self.gains()
        else:
            gains = self._gains(without.S, without.P)
        best = int(gains.argmax())
        scale = 1.0 if self._criterion == "D" else float(gains[number])
        exchanged = float(gains[best] - gains[number]) > LEAST_GAIN * scale
        if without is not None and not exchanged:
            self.chosen.append(number)
            return False
        if without is not None:
            self._take(without)
        self.add(best if exchanged else number)
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
        """The covariance with the chosen candidates, from the beginning."""
        rows = self._B[self.chosen].flatten(0, 1)
        information = torch.eye(rows.shape[1]).to(rows) + rows.t() @ rows
        self._C = torch.cholesky_inverse(torch.linalg.cholesky(information))
        along = self._B @ self._C
        self._S = along @ self._B.mT  # covariance of the values of every candidate
        self._X = along @ self._goal.t() if self._criterion == "I" else self._B[..., :0]  # with the task
        self._P = self._X @ self._X.mT

    def _change(self, number: int, sign: float) -> _Change | None:
        """What a candidate more (+1) or fewer (-1) changes; None where taking it back loses all digits."""
        G = self._C @ self._B[number].t()
        here = torch.eye(G.shape[1]).to(G) + sign * self._B[number] @ G
        lower, failed = torch.linalg.cholesky_ex(here)
        if sign < 0 and (int(failed) or float(lower.diagonal().min()) < LEAST_LEFT):
            return None
        # by rows: products with all candidates read it as it lies
        half = torch.linalg.solve_triangular(lower, G.t(), upper=False).contiguous()
        U = self._B @ half.t()
        P = self._P
        if self._criterion == "I" and sign < 0:  # where one is added, this would cancel, and X says it
            task = half @ self._goal.t()
            cross = (self._X @ task.t()) @ U.mT
            P = P + cross + cross.mT + U @ (task @ task.t()) @ U.mT
        return _Change(sign, half, U, self._S - sign * U @ U.mT, P)

    def _take(self, change: _Change) -> None:
        """Let the candidates be changed."""
        half, U, self._S, self._P = change.half, change.along, change.S, change.P
        self._C -= change.sign * half.t() @ half
        if self._criterion == "I":
            self._X.flatten(0, 1).addmm_(U.flatten(0, 1), half @ self._goal.t(), alpha=-change.sign)
            if change.sign > 0:
                self._P = self._X @ self._X.mT

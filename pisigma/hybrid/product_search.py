"""Which product units: kept where rows that they never saw are predicted better with them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from pisigma.hybrid.design import sum_up
from pisigma.hybrid.evidence import Posterior, solve_posterior
from pisigma.hybrid.products import ProductFit
from pisigma.hybrid.rows import Rows
from pisigma.hybrid.search import Additive, Search, Trial

FOLDS = 4
"""Parts of the training rows on which product units are judged."""
MOST_CONFIGURATIONS = 600
"""They are judged on so many configurations at most."""
LEAST_CONFIGURATIONS = 40
"""They are not looked for among fewer."""
BETTER = 0.98
"""Held-out RMS must fall below this share for product units to be kept."""


@dataclass(frozen=True, eq=False)
class _Fold:
    """Rows that are held out, and the additive model fitted to the others, prior sizes and noise held."""

    test: Rows
    additive: Additive
    base: Posterior
    fit: ProductFit

    def square(self, orders: tuple[int, ...], noise: tuple[float, ...]) -> float:
        """Squared errors of the held-out rows over variances; additive where there are no orders."""
        if not orders:
            return float(self.test.left(self.additive.design, self.base, noise).sum())
        found = self.fit.fit(orders, 0)
        return float(self.test.left(found.design, found.posterior, noise).sum())


def best_products(
    search: Search, additive: Additive, choices: Sequence[tuple[int, ...]]
) -> tuple[Additive, tuple[int, ...]]:
    """Choose product units, and then once more the series beside them.

    Every choice is fitted to all but one of `FOLDS` parts of the rows at a time, and judged on that part. As long as
    interactions between joints are not modelled, a series takes up some of them; with product units fewer
    harmonics may be better.

    Args:
        search: the rows, and what was tried on them; its table gets a line for every choice.
        additive: the best unit of order 1.
        choices: orders of product units, tried in turn; if the first does not help, the others are not tried.

    Returns:
        The unit of order 1 and the orders; no orders where product units do not help.
    """
    if not choices or search.rows.configurations < LEAST_CONFIGURATIONS:
        return additive, ()
    last = next(trial.left_out for trial in reversed(search.trials) if trial.kept)
    folds = _folds(search, additive)
    first = least = sum(fold.square((), search.noise) for fold in folds)
    best: tuple[int, ...] = ()
    for orders in choices:
        square, better = _judged(search, additive, folds, orders, least, (last, first))
        if better:
            best, least = orders, square
        if not best:
            return additive, ()
    fewer = [
        other
        for other in search.fitted
        if 0 < other.size < additive.size
        and {c.name for c in other.design.features} == {c.name for c in additive.design.features}
    ]
    for other in sorted(fewer, key=lambda one: -one.size):
        square, better = _judged(search, other, _folds(search, other), best, least / BETTER**2, (last, first))
        if not better:
            break
        additive, least = other, square
    return additive, best


def _judged(
    search: Search,
    additive: Additive,
    folds: Sequence[_Fold],
    orders: tuple[int, ...],
    least: float,
    unit: tuple[float, float],
) -> tuple[float, bool]:
    """Squared errors of held-out rows, and whether they are clearly below the least so far; adds a line."""
    name = f"{additive.name} + products {orders}"
    search.progress(name)
    began = time.monotonic()
    square = sum(fold.square(orders, search.noise) for fold in folds)
    better = square < least * BETTER**2
    inputs = folds[0].fit.inputs
    unknowns = additive.design.unknowns + search.rows.problem.space.robot.dof * sum(orders) * inputs
    left_out = unit[0] * (square / unit[1]) ** 0.5
    seconds = time.monotonic() - began
    search.trials.append(Trial(name, unknowns, float("nan"), left_out, seconds, better))
    return square, better


def _folds(search: Search, additive: Additive) -> list[_Fold]:
    """Parts of at most `MOST_CONFIGURATIONS` configurations."""
    rows, design = search.rows, additive.design
    order = torch.randperm(rows.configurations, generator=torch.Generator().manual_seed(0))
    order = order[:MOST_CONFIGURATIONS]
    parts = []
    for k in range(FOLDS):
        held = torch.zeros(rows.configurations, dtype=torch.bool)
        held[order[k::FOLDS]] = True
        seen = torch.zeros_like(held)
        seen[order] = True
        device = rows.configuration.device
        train, test = rows.of((seen & ~held).to(device)), rows.of(held.to(device))
        sums = sum_up(design, train.values, train.start(design))
        base = solve_posterior(sums, additive.posterior.prior, additive.posterior.noise)
        fit = ProductFit(design, train.values, train.start(design), base, sums)
        parts.append(_Fold(test, additive, base, fit))
    return parts

"""Tables of the coverage of predicted intervals."""

import numpy as np
import scipy.stats

from shared_benchmark.comparison import EXTRAPOLATING
from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.results import Results, table
from shared_benchmark.scores import RowErrors

SCATTER = 0.99
"""Probability of the binomial interval of a coverage."""
SHARE = 0.95
"""Share of coordinates that the intervals of the pooled table shall contain."""


def binomial_interval(errors: RowErrors, share: float) -> tuple[float, float]:
    """Return the interval of the coverage of exact intervals, for as many independent trials as configurations."""
    count = len(np.unique(errors.group))
    low, high = scipy.stats.binom.interval(SCATTER, count, share)
    return float(low) / count, float(high) / count


def agrees(errors: RowErrors, share: float) -> bool:
    """Return whether a coverage differs from a nominal share by no more than fits of one kind differ (99 %, t test)."""
    limit = scipy.stats.t.ppf((1 + SCATTER) / 2, len(np.unique(errors.fold)) - 1)
    return bool(abs(errors.coverage(share) - share) <= limit * errors.coverage_error(share))


def covered(results: Results, method: str) -> dict[tuple[str, str], RowErrors]:
    """Return the errors of a method by series and split, where it predicts deviations."""
    found = {(name, split): results.errors.get((name, split, method)) for name, split in results.pairs}
    return {key: one for key, one in found.items() if one is not None and np.isfinite(one.sigma).all()}


def coverage_table(results: Results) -> str:
    """Return the coverage of every split and method, and whether it is within binomial scatter."""
    rows = []
    for name, split in results.pairs:
        for method in METHODS:
            errors = covered(results, method).get((name, split))
            if errors is None:
                continue
            low, high = binomial_interval(errors, SHARE)
            coverage = errors.coverage(SHARE)
            place = "within" if low <= coverage <= high else "below" if coverage < low else "above"
            figures = [f"{errors.coverage(0.9):.1%}", f"{coverage:.1%}", f"{low:.1%} to {high:.1%}, {place}"]
            predicted = float(np.sqrt(np.square(errors.sigma).sum(1).mean()))
            figures += [f"{predicted:.3f}", f"{errors.rms:.3f}"]
            rows.append([f"`{name}`", f"`{split}`", f"`{method}`", *figures])
    head = ["series", "split", "method", "90 %", "95 %", "99 % interval of the 95 %", "predicted RMS [mm]"]
    return table([*head, "RMS [mm]"], rows)


def pooled_table(results: Results) -> str:
    """Return the coverage of all splits together, inside and outside the fitted rows."""
    rows = []
    for method in METHODS:
        every = covered(results, method)
        inside = [one for (_, split), one in every.items() if split not in EXTRAPOLATING]
        outside = [one for (_, split), one in every.items() if split in EXTRAPOLATING]
        if inside:
            within = 0
            for one in inside:
                low, high = binomial_interval(one, SHARE)
                within += low <= one.coverage(SHARE) <= high
            of_fits = sum(agrees(one, SHARE) for one in inside)
            cells = [f"{_pooled(ones):.1%}" if ones else "" for ones in (inside, outside)]
            counts = [f"{count} of {len(inside)}" for count in (within, of_fits)]
            rows.append([f"`{method}`", cells[0], *counts, cells[1]])
    head = ["method", "95 % intervals, inside", "splits within binomial scatter"]
    head += ["splits within the scatter between fits", "outside"]
    return table(head, rows)


def _pooled(ones: list[RowErrors]) -> float:
    """Return the share of coordinates within 95 % intervals of several splits."""
    sizes = [one.error.size for one in ones]
    return float(np.average([one.coverage(SHARE) for one in ones], weights=sizes))

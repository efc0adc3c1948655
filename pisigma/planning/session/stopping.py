"""Stopping rule of a measuring session."""

from collections.abc import Sequence

from pisigma.planning.session.state import AccuracyPoint, Advice

AHEAD = 10
"""Number of next poses whose expected benefit decides whether to stop."""


def advice(
    limit_mm: float | None,
    least_gain_mm: float,
    reached: Sequence[AccuracyPoint],
    expected: Sequence[AccuracyPoint],
    left: int,
) -> Advice:
    """Decide whether to measure on or to stop, and why.

    Args:
        limit_mm: limit of the 95 % quantile of the errors [mm]; None for no limit.
        least_gain_mm: decrease of that quantile by the next `AHEAD` poses below which to stop [mm].
        reached: accuracy so far. The limit is reached when the last two points are below it: estimates from few rows
            scatter, so that a first point below the limit is often there by chance.
        expected: expected accuracy after the remaining poses.
        left: number of remaining poses.
    """
    limit = "" if limit_mm is None else f"; the limit is {limit_mm:g} mm"
    if reached:
        point = reached[-1]
        now = f"95 % of the errors are expected below {point.predicted_p95 * 1e3:.3f} mm"
        below = [limit_mm is not None and one.predicted_p95 * 1e3 <= limit_mm for one in reached[-2:]]
        if len(below) > 1 and all(below):
            return Advice("stop", f"Stop: with {point.poses} poses {now}{limit}.")
        confirm = ", which the next poses must confirm" if below[-1] else ""
        ahead = next((one for one in expected if one.poses >= point.poses + AHEAD), None) or next(
            reversed(expected), None
        )
        gain = 0.0 if ahead is None else (point.predicted_p95 - ahead.predicted_p95) * 1e3
        if ahead is not None and gain < least_gain_mm:
            more = f"{ahead.poses - point.poses} more poses would lower that by {max(gain, 0.0):.4f} mm only"
            return Advice("stop", f"Stop: {now}{limit}; {more}.")
    if not left:
        return Advice("stop", f"Stop: all poses of the plan have been measured{limit}.")
    if not reached:
        return Advice("measure", f"{left} poses remain; there are too few rows to estimate the accuracy.")
    return Advice("measure", f"{left} poses remain; {now}{limit}{confirm}.")

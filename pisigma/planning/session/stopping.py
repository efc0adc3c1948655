"""When more poses would not help."""

from collections.abc import Sequence

from pisigma.planning.session.state import AccuracyPoint, Advice

AHEAD = 10
"""What more poses bring is judged by so many, or all that are left."""


def advice(
    limit_mm: float | None,
    least_gain_mm: float,
    reached: Sequence[AccuracyPoint],
    expected: Sequence[AccuracyPoint],
    left: int,
) -> Advice:
    """Say whether to go on, and why.

    Args:
        limit_mm: 95 % of the errors are to stay below [mm]; None for no limit.
        least_gain_mm: by which the next `AHEAD` poses have to lower that [mm].
        reached: accuracy so far; the last point holds, and it has reached the limit if the one before it has, too: what
            few rows say of themselves scatters, and the first of many points below the limit is often there by chance.
        expected: accuracy that the poses that are left would bring.
        left: number of poses that are left.
    """
    limit = "" if limit_mm is None else f"; the limit is {limit_mm:g} mm"
    if reached:
        point = reached[-1]
        now = f"95 % of the errors are expected below {point.predicted_p95 * 1e3:.3f} mm"
        below = [limit_mm is not None and one.predicted_p95 * 1e3 <= limit_mm for one in reached[-2:]]
        if len(below) > 1 and all(below):
            return Advice("stop", f"Stop: with {point.poses} poses {now}{limit}.")
        confirm = ", which the next poses have to confirm" if below[-1] else ""
        ahead = next((one for one in expected if one.poses >= point.poses + AHEAD), None) or next(
            reversed(expected), None
        )
        gain = 0.0 if ahead is None else (point.predicted_p95 - ahead.predicted_p95) * 1e3
        if ahead is not None and gain < least_gain_mm:
            more = f"{ahead.poses - point.poses} more poses would lower that by {max(gain, 0.0):.4f} mm only"
            return Advice("stop", f"Stop: {now}{limit}; {more}.")
    if not left:
        return Advice("stop", f"Stop: all poses of the plan are measured{limit}.")
    if not reached:
        return Advice(
            "measure", f"{left} poses are left; there are too few rows to say how accurate they are."
        )
    return Advice("measure", f"{left} poses are left; {now}{limit}{confirm}.")

"""What a server has answered, and how long that took."""

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass

KEPT = 4096
"""Of so many last calls the durations are known."""


@dataclass(frozen=True)
class MetricsSummary:
    """What a server says of itself.

    Attributes:
        uptime_s: since when it serves [s].
        calls: requests that were answered.
        p50_us: median time of the last `KEPT` requests, from when one was read until its answer stood ready [µs]; None
            before the first.
        p99_us: the time that 99 % of them stay below [µs].
        statuses: how many calls ended with which status; "forward", "path" and "refused" among them.
        connections: that are open now.
        cut_off: connections that were closed because they were slow or broken.
    """

    uptime_s: float
    calls: int
    p50_us: float | None
    p99_us: float | None
    statuses: dict[str, int]
    connections: int
    cut_off: int


class Metrics:
    """Counts requests; one call costs less than a microsecond.

    Attributes:
        connections: that are open now.
        cut_off: connections that were closed because they were slow or broken.
    """

    def __init__(self) -> None:
        self.connections = self.cut_off = 0
        self._begun, self._lock = time.monotonic(), threading.Lock()
        self._statuses: Counter[str] = Counter()
        self._durations: deque[int] = deque(maxlen=KEPT)

    def count(self, status: str, begun_ns: int) -> None:
        """Count an answer.

        Args:
            status: of the answer.
            begun_ns: `time.perf_counter_ns()` when its request was read.
        """
        with self._lock:
            self._statuses[status] += 1
            self._durations.append(time.perf_counter_ns() - begun_ns)

    def summary(self) -> MetricsSummary:
        """Give the present figures."""
        with self._lock:
            durations, statuses = list(self._durations), dict(self._statuses.most_common())
        durations.sort()
        return MetricsSummary(
            round(time.monotonic() - self._begun, 3),
            sum(statuses.values()),
            _quantile_us(durations, 0.5),
            _quantile_us(durations, 0.99),
            statuses,
            self.connections,
            self.cut_off,
        )


def _quantile_us(durations: list[int], share: float) -> float | None:
    return durations[int(share * (len(durations) - 1))] / 1e3 if durations else None

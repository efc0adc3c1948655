"""Counts and durations of a server's answers."""

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass

KEPT_DURATIONS = 4096
"""Number of latest requests whose durations are stored."""


@dataclass(frozen=True)
class MetricsSummary:
    """Figures of a server.

    Attributes:
        uptime_s: time since the start of the server [s].
        calls: number of answered requests.
        p50_us: median of the last `KEPT_DURATIONS` durations from reading a request to its answer [µs]; None before the
            first request.
        p99_us: 99 % quantile of these durations [µs].
        statuses: number of requests by status, including "forward", "path" and "refused".
        connections: number of open connections.
        cut_off: number of connections that were closed because they were slow or broken.
    """

    uptime_s: float
    calls: int
    p50_us: float | None
    p99_us: float | None
    statuses: dict[str, int]
    connections: int
    cut_off: int


class Metrics:
    """Counters of requests; counting a request takes less than a microsecond.

    Attributes:
        connections: number of open connections.
        cut_off: number of connections that were closed because they were slow or broken.
    """

    def __init__(self) -> None:
        self.connections = self.cut_off = 0
        self._begun, self._lock = time.monotonic(), threading.Lock()
        self._statuses: Counter[str] = Counter()
        self._durations: deque[int] = deque(maxlen=KEPT_DURATIONS)

    def count(self, status: str, begun_ns: int) -> None:
        """Count an answer.

        Args:
            status: status of the answer.
            begun_ns: `time.perf_counter_ns()` when the request was read.
        """
        with self._lock:
            self._statuses[status] += 1
            self._durations.append(time.perf_counter_ns() - begun_ns)

    def summary(self) -> MetricsSummary:
        """Return the current figures of the server."""
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

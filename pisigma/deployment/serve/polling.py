"""Busy polling for the next request while requests are frequent, because waking up takes longer than answering."""

import math
import selectors
import time

POLL_DURATION = 2.5e-3
"""Duration of polling after a request, which is long enough for clients that ask every 2 ms [s]."""
MAX_GAP = 5e-4
"""Gap between two polls above which other programs or threads used the processor [s]."""
REST_FACTOR = 100.0
"""Duration of a pause in polling, as a multiple of the gap, so that gaps delay at most one request in a hundred."""


class Polling:
    """Polling for requests without sleeping, after two of them have followed each other within a stated time.

    It pauses when other programs need the processor, because the scheduler delays a program that never sleeps.
    """

    def __init__(self, selector: selectors.BaseSelector, duration: float) -> None:
        """Store the selector of the connections and the duration of polling after a request [s]; 0 disables polling."""
        self._selector, self._duration = selector, duration
        self._last, self._often, self._resting_until = -math.inf, False, -math.inf

    def wait_for_connections(self) -> list[tuple[selectors.SelectorKey, int]]:
        """Return ready connections as soon as there are some, or an empty list when it is time to sleep."""
        now = time.monotonic()
        while self._often and self._resting_until < now < self._last + self._duration:
            if ready := self._selector.select(0):
                return ready
            before, now = now, time.monotonic()
            if now - before > MAX_GAP:
                self._resting_until = now + REST_FACTOR * (now - before)
        return []

    def record_activity(self) -> None:
        """Record that a request has just been handled."""
        before, self._last = self._last, time.monotonic()
        self._often = self._last - before < self._duration

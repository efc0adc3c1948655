"""Staying awake for the next request where requests come often, for waking up takes longer than answering."""

import math
import selectors
import time

DURATION = 2.5e-3
"""[s] After a request, so that clients that ask every 2 ms find the server awake."""
TAKEN_AWAY = 5e-4
"""[s] Between two looks, if other programs or threads had the processor meanwhile."""
REST = 100.0
"""Times as long nothing is polled after that, so that no more than one request in a hundred waits for it."""


class Polling:
    """Looks for requests without sleeping, after two of them followed each other within a stated time.

    Where others want the processor it rests: the scheduler lets a program that never sleeps wait longest.
    """

    def __init__(self, selector: selectors.BaseSelector, duration: float) -> None:
        """Take what says which connections can go on, and how long to stay awake after a request [s]; 0 for never."""
        self._selector, self._duration = selector, duration
        self._last, self._often, self._resting_until = -math.inf, False, -math.inf

    def ready(self) -> list[tuple[selectors.SelectorKey, int]]:
        """Give the connections that can go on, as soon as there are some; none when it is time to sleep."""
        now = time.monotonic()
        while self._often and self._resting_until < now < self._last + self._duration:
            if ready := self._selector.select(0):
                return ready
            before, now = now, time.monotonic()
            if now - before > TAKEN_AWAY:
                self._resting_until = now + REST * (now - before)
        return []

    def went_on(self) -> None:
        """Take note that connections go on now."""
        before, self._last = self._last, time.monotonic()
        self._often = self._last - before < self._duration

"""When the server polls for the next request."""

import pytest

from pisigma.deployment.serve import polling
from pisigma.deployment.serve.polling import MAX_GAP, REST_FACTOR, Polling

DURATION = 0.02


class _Sockets:
    """A clock, and sockets at which a request arrives at a stated poll; each poll takes some time."""

    def __init__(self):
        self.now, self.look, self.looks, self.request_at = 100.0, MAX_GAP / 5, 0, None

    def monotonic(self):
        return self.now

    def select(self, timeout):
        assert timeout == 0
        self.looks += 1
        self.now += self.look
        return ["request"] if self.looks == self.request_at else []


@pytest.fixture
def sockets(monkeypatch):
    sockets = _Sockets()
    monkeypatch.setattr(polling, "time", sockets)
    return sockets


def _after_two_requests(sockets, apart=0.0, duration=DURATION):
    polling = Polling(sockets, duration)
    polling.record_activity()
    sockets.now += apart
    polling.record_activity()
    return polling


def test_the_next_of_frequent_requests_is_polled_for(sockets):
    sockets.request_at = 3
    assert _after_two_requests(sockets).wait_for_connections() == ["request"]
    assert sockets.looks == 3


def test_the_server_sleeps_when_no_request_comes_in_time(sockets):
    begun = sockets.now
    assert _after_two_requests(sockets).wait_for_connections() == []
    assert DURATION <= sockets.now - begun < 1.1 * DURATION


@pytest.mark.parametrize(("apart", "duration"), [(2 * DURATION, DURATION), (0.0, 0.0)])
def test_after_rare_requests_or_without_a_duration_the_server_sleeps_at_once(sockets, apart, duration):
    assert _after_two_requests(sockets, apart, duration).wait_for_connections() == []
    assert sockets.looks == 0


def test_a_single_request_does_not_start_polling(sockets):
    polling = Polling(sockets, DURATION)
    polling.record_activity()
    assert polling.wait_for_connections() == []
    assert sockets.looks == 0


def test_polling_pauses_when_others_need_the_processor(sockets):
    sockets.look = 2 * MAX_GAP
    busy = _after_two_requests(sockets)
    for looks, pause in ((1, 0.0), (1, 0.6), (2, 0.6)):
        sockets.now += pause * REST_FACTOR * sockets.look
        busy.record_activity()
        busy.record_activity()
        assert busy.wait_for_connections() == []
        assert sockets.looks == looks

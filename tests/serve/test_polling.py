"""When the server stays awake for the next request."""

import time

import pytest

from pisigma.serve.polling import TAKEN_AWAY, Polling

DURATION = 0.02


class _Selector:
    """Finds a request at the stated look, of which each takes a while."""

    def __init__(self, request_at=10**9, look=0.0):
        self.looks, self.request_at, self.look = 0, request_at, look

    def select(self, timeout):
        assert timeout == 0
        self.looks += 1
        time.sleep(self.look)
        return ["request"] if self.looks == self.request_at else []


def _busy(selector, duration=DURATION):
    """After two requests at once."""
    polling = Polling(selector, duration)
    polling.went_on()
    polling.went_on()
    return polling


def test_the_next_of_frequent_requests_finds_the_server_awake():
    selector = _Selector(request_at=3)
    assert _busy(selector).ready() == ["request"]
    assert selector.looks == 3


def test_the_server_sleeps_when_no_request_comes_in_time():
    selector, begun = _Selector(), time.monotonic()
    assert _busy(selector).ready() == []
    assert selector.looks > 0
    assert time.monotonic() - begun >= DURATION / 2


@pytest.mark.parametrize("pause", [None, 1.5 * DURATION])
def test_an_idle_server_never_polls(pause):
    selector = _Selector()
    polling = Polling(selector, DURATION)
    polling.went_on()
    if pause is not None:
        time.sleep(pause)
        polling.went_on()
    assert polling.ready() == []
    assert selector.looks == 0


def test_without_a_duration_nothing_is_polled():
    selector = _Selector()
    assert _busy(selector, 0.0).ready() == []
    assert selector.looks == 0


def test_the_server_rests_where_others_want_the_processor():
    selector = _Selector(look=2 * TAKEN_AWAY)
    polling = _busy(selector)
    assert polling.ready() == []
    assert selector.looks == 1
    polling.went_on()
    assert polling.ready() == []
    assert selector.looks == 1

"""Time stamps of many countries."""

import pytest
from testing.closeness import assert_close

from pisigma.measurement.foreign.time_stamps import seconds_of


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("12.5", 12.5),
        ("10:31:02.5", 37862.5),
        ("10:31", 37860.0),
        ("2026-03-02T10:31:02.5Z", 1772447462.5),
        ("2026-03-02T12:31:02.5+02:00", 1772447462.5),
        ("2026-03-02 07:01:02,5-0330", 1772447462.5),
        ("2026-03-02 05:31:02.5-05", 1772447462.5),
        ("20260302T103102.5Z", 1772447462.5),
        ("2026-03-02", 1772409600.0),
        ("2026/03/02 10:31:02.5", 1772447462.5),
        ("02.03.2026 10:31:02.5", 1772447462.5),
        ("13/03/2026 10:31:02.5", 1773397862.5),
        ("03/13/2026 10:31:02.5 AM", 1773397862.5),
        ("3/3/2026 10:31:02,5", 1772533862.5),
        ("12:05:00 AM", 300.0),
        ("12:05:00 PM", 43500.0),
    ],
)
def test_time_stamps(text: str, seconds: float):
    assert_close(seconds_of(text), seconds, atol=0.0)


def test_invalid_time_stamps():
    assert seconds_of("noon") is None
    assert seconds_of("nan") is None
    assert seconds_of("02/03/2026 10:31") is None  # the second of March, or the third of February
    assert seconds_of("02/03/2026 10:31", True) == seconds_of("2026-03-02 10:31")
    assert seconds_of("02/03/2026 10:31", False) == seconds_of("2026-02-03 10:31")
    assert [seconds_of(text) for text in ("13:05 PM", "25:00", "32.03.2026 10:00", "02/03/26 10:31")] == [
        None
    ] * 4

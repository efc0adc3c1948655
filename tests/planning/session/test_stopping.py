"""Stopping rule of measuring sessions."""

from pisigma.planning.session.session_rows import stopping_advice
from pisigma.planning.session.state import AccuracyPoint


def point(poses: int, p95_mm: float) -> AccuracyPoint:
    return AccuracyPoint(poses, 0.6e-3 * p95_mm, 1e-3 * p95_mm)


def test_the_limit_ends_the_session():
    reached, ahead = [point(12, 0.4), point(15, 0.14), point(18, 0.12)], [point(25, 0.08)]
    said = stopping_advice(0.15, 0.005, reached, ahead, 10)
    assert said.action == "stop"
    assert all(number in said.sentence for number in ("18 poses", "0.120 mm", "0.15 mm"))
    assert stopping_advice(0.15, 0.005, reached[:1], ahead, 10).action == "measure"
    assert stopping_advice(0.15, 0.005, reached[1:2], ahead, 10).action == "measure"


def test_the_first_point_below_the_limit_has_to_be_confirmed():
    reached, ahead = [point(12, 0.4), point(15, 0.14)], [point(25, 0.08)]
    said = stopping_advice(0.15, 0.005, reached, ahead, 10)
    assert said.action == "measure"
    assert all(number in said.sentence for number in ("10 poses", "0.140 mm", "0.15 mm"))
    assert stopping_advice(0.15, 0.005, reached, [], 0).action == "stop"


def test_little_gain_ends_the_session():
    said = stopping_advice(
        0.01, 0.005, [point(40, 0.1)], [point(45, 0.097), point(50, 0.096), point(60, 0.05)], 20
    )
    assert said.action == "stop"
    assert "10 more poses" in said.sentence
    assert "0.0040 mm" in said.sentence
    assert stopping_advice(0.01, 0.003, [point(40, 0.1)], [point(50, 0.096)], 20).action == "measure"


def test_the_last_pose_ends_the_session():
    assert stopping_advice(0.05, 0.0, [point(40, 0.1)], [], 0).action == "stop"
    assert stopping_advice(None, 0.005, [], [], 0).action == "stop"


def test_without_an_accuracy_measuring_continues():
    said = stopping_advice(0.15, 0.005, [], [], 12)
    assert said.action == "measure"
    assert "12 poses" in said.sentence

"""Multiples of 90 deg without rounding errors, in angles and in their sines and cosines."""

import math

ROUNDING = 2e-14
"""Largest deviation of a length from 0 [m] and of an angle from a multiple of 90 deg [rad] that is a rounding error."""


def cosine_sine(angle: float) -> tuple[float, float]:
    """Return cosine and sine, exactly 0 and ±1 within 1e-15 rad of a multiple of 90 deg."""
    quarter = angle / (math.pi / 2)
    if abs(quarter - round(quarter)) < 1e-15 * max(1.0, abs(quarter)):
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarter) % 4]
    return math.cos(angle), math.sin(angle)


def snap_right_angle(value: float) -> float:
    """Replace an angle [rad] within rounding of a multiple of 90 deg with that multiple, in (-pi, pi]."""
    quarters = round(value / (math.pi / 2))
    if abs(value - quarters * (math.pi / 2)) > ROUNDING:
        return float(value)
    return (2 if quarters == -2 else quarters) * (math.pi / 2)

"""Colours of errors and of objects in the scene."""

import math

import numpy as np
from jaxtyping import Float64, UInt8

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

LINKS: Color = (176, 184, 192)
NEXT: Color = (31, 95, 168)
PLANNED: Color = (165, 190, 220)
ALARM: Color = (200, 30, 30)
UNJUDGED: Color = (150, 150, 150)
TRACKER: Color = (45, 45, 45)
FORBIDDEN: Color = (200, 90, 40)
SIGHT: Color = (230, 160, 0)

RAMP = (
    "#440154",
    "#482878",
    "#3e4989",
    "#31688e",
    "#26828e",
    "#1f9e89",
    "#35b779",
    "#6ece58",
    "#b5de2b",
    "#fde725",
)
"""Colour ramp "viridis" with even steps of lightness, readable in grey and with colour blindness."""


def error_colors(errors: Float64[np.ndarray, " rows"], max_error: float) -> UInt8[np.ndarray, "rows 3"]:
    """Return the colour of every row's error.

    Args:
        errors: errors [m]; NaN is shown in grey.
        max_error: error of the last colour [m].
    """
    ramp = np.array([[int(color[k : k + 2], 16) for k in (1, 3, 5)] for color in RAMP], dtype=np.float64)
    at = np.nan_to_num(errors / max_error).clip(0.0, 1.0) * (len(RAMP) - 1)
    colors = np.stack([np.interp(at, np.arange(len(RAMP)), channel) for channel in ramp.T], axis=1)
    colors[~np.isfinite(errors)] = UNJUDGED
    return colors.round().astype(np.uint8)


def round_up(value: float) -> float:
    """Return a value rounded up to 1, 2 or 5 times a power of ten; 1 if the value is not positive."""
    if not value > 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1 - 1e-9))

"""Drift of pose characteristics: how accuracy and repeatability change while the robot warms up."""

from jaxtyping import Float
from torch import Tensor


def accuracy_drift(accuracy: Float[Tensor, "times *kinds"]) -> Float[Tensor, "times *kinds"]:
    """Drift of pose accuracy dAP (ISO 9283:1998, 7.6): `dAP = |AP_{t=1} - AP_{t=T}|`.

    Args:
        accuracy: AP at every time, of positions [m] or of angles [rad], such as `position_accuracy(...).length` of
            `(times, n, 3)`.

    Returns:
        The drift up to every time; the last is that of the standard, 0 is the first.
    """
    return (accuracy[:1] - accuracy).abs()


def repeatability_drift(repeatability: Float[Tensor, "times *kinds"]) -> Float[Tensor, "times *kinds"]:
    """Drift of pose repeatability dRP (ISO 9283:1998, 7.6): `dRP = RP_{t=1} - RP_{t=T}`.

    Args:
        repeatability: RP at every time, of positions [m] or of angles [rad].

    Returns:
        The drift up to every time, above 0 where the robot repeats better than at first; the last is that of the
        standard.
    """
    return repeatability[:1] - repeatability

"""Measurements: joint values commanded, and what a sensor saw there."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.errors import MeasurementError


@dataclass(frozen=True, eq=False)
class Measurements:
    """One row a measurement, in SI units.

    What was not measured in a row is NaN there; a column that no row has is None.

    Attributes:
        q: commanded joint values [rad or m], as the controller counts.
        position: measured position of the target in its frame [m].
        rotation: measured rotation of the tool in its frame.
        frame: per row, the frame the sensor measures from; one name where the file has none.
        target: per row, which reflector on the tool was seen.
        sigma_position: per row, standard deviation of a measured coordinate [m], where given.
        sigma_rotation: per row, standard deviation of a measured angle [rad], where given.
        split: per row "train" or "test" (column `set`), where given.
        payload: per row [kg], where given.
        temperature: per row [deg C], where given.
        line: per row, the line in the file it came from (0 where it came from none).
        source: the file, or what made the rows.
    """

    q: Float64[Tensor, "rows dof"]
    position: Float64[Tensor, "rows 3"] | None = None
    rotation: Float64[Tensor, "rows 3 3"] | None = None
    frame: tuple[str, ...] = ()
    target: tuple[str, ...] = ()
    sigma_position: Float64[Tensor, " rows"] | None = None
    sigma_rotation: Float64[Tensor, " rows"] | None = None
    split: tuple[str, ...] | None = None
    payload: Float64[Tensor, " rows"] | None = None
    temperature: Float64[Tensor, " rows"] | None = None
    line: tuple[int, ...] = ()
    source: str = "memory"

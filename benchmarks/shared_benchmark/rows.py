"""What a method gets and returns, as numpy arrays, so that its process needs neither pisigma nor torch."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np

Array = np.ndarray
Measured = Literal["position", "pose", "socket"]
"""What the rows of a series contain: positions, positions with rotations, or sockets in which the tool's ball sits."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a series in SI units; what was not measured, or is held out, is None.

    Attributes:
        q: joint values (rows, dof) [rad].
        target: name of the measured point on the tool (rows,).
        position: measured positions (rows, 3) in the frame of the sensor [m].
        rotation: measured rotations of the tool (rows, 3, 3) in the frame of the sensor.
        temperature: (rows,) [deg C].
        socket: name of the socket (rows,).
    """

    q: Array
    target: Array
    position: Array | None = None
    rotation: Array | None = None
    temperature: Array | None = None
    socket: Array | None = None

    def select(self, index: Array) -> "Rows":
        """Return the rows with the given numbers."""
        return Rows(**{name: values[index] for name, values in self.arrays().items()})

    def without_measurements(self) -> "Rows":
        """Return what a method may know of held-out rows."""
        return Rows(self.q, self.target, temperature=self.temperature, socket=self.socket)

    def arrays(self) -> dict[str, Array]:
        """Return the fields that are not None."""
        named = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: values for name, values in named.items() if values is not None}


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted poses.

    Attributes:
        T: poses (rows, 4, 4) of the targets in the frame of the sensor; for sockets, in any fixed frame. The rotation
            is NaN if the method predicts none.
        sigma: predicted standard deviation (rows, 3) of the measured minus the predicted position along the axes of
            that frame, with the noise of the sensor [m]; None if the method predicts none.
    """

    T: Array
    sigma: Array | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """One fit.

    Attributes:
        series: name of the series.
        dh: nominal parameters (rows, 5) of `RotZ(theta + q) Trans(a, 0, d) RotX(alpha) RotY(beta)`: theta [rad], d [m],
            a [m], alpha [rad], beta [rad].
        direction: sign of the joint value of every row (rows,); 0 for fixed rows.
        train: the rows to fit.
        test: the rows to predict, without measurements.
        distances: known distance [m] of two sockets of every placement, by the names of both after the placement.
        seed: random seed.
    """

    series: str
    dh: Array
    direction: Array
    train: Rows
    test: Rows
    distances: Mapping[tuple[str, str], float]
    seed: int

    def save(self, path: Path) -> None:
        """Write the task."""
        arrays = {
            f"{name}.{key}": values
            for name in ("train", "test")
            for key, values in getattr(self, name).arrays().items()
        }
        pairs = np.array(
            [[first, second, repr(length)] for (first, second), length in self.distances.items()], dtype=str
        )
        np.savez(
            path,
            series=self.series,
            dh=self.dh,
            direction=self.direction,
            distances=pairs,
            seed=self.seed,
            **arrays,
        )

    @staticmethod
    def load(path: Path) -> "Task":
        """Read a task."""
        with np.load(path) as stored:
            parts = {
                name: {key.partition(".")[2]: stored[key] for key in stored if key.startswith(f"{name}.")}
                for name in ("train", "test")
            }
            distances = {
                (str(first), str(second)): float(length) for first, second, length in stored["distances"]
            }
            return Task(
                str(stored["series"]),
                stored["dh"],
                stored["direction"],
                Rows(**parts["train"]),
                Rows(**parts["test"]),
                distances,
                int(stored["seed"]),
            )


Predict = Callable[[Rows], Prediction]


@dataclass(frozen=True)
class Method:
    """A method of calibration.

    Attributes:
        name: short name, which is that of its file.
        title: what is shown on the page.
        source: where the method is published.
        packages: distributions that it needs, whose versions are recorded.
        measured: kinds of rows that it can use.
        fit: function that fits the rows `task.train` and returns a function that predicts others.
        slow: whether `--quick` leaves it out.
    """

    name: str
    title: str
    source: str
    packages: tuple[str, ...]
    measured: tuple[Measured, ...]
    fit: Callable[[Task], Predict]
    slow: bool = False

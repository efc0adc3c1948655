"""A public series of measurements: its source, how it is read, and how its rows are split."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from pisigma.files.errors import MeasurementError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.socket import expand_socket_names
from pisigma.robot import Robot
from shared_benchmark.rows import Rows

DATA = Path(os.environ.get("PISIGMA_DATA", Path(__file__).parents[2] / ".." / "shared" / "data")).resolve()
"""Folder of the files of all series."""


@dataclass(frozen=True)
class Series:
    """A series of measurements of one arm.

    Attributes:
        name: short name, which is also the name of the module.
        title: title on the page.
        citation: author, year, and where the measurements are published.
        url: address of the published files, at a fixed commit.
        licence: licence of the published files.
        sensor: the instrument, and the quantity that it measured.
        file: path of the file below the data folder; its columns state the units.
        sha256: SHA-256 of this file.
        robot: name in pisigma's catalogue.
        splits: SHA-256 of the row numbers of every split, by name; see `splits.py`.
        urdf: path of a URDF file below the data folder that replaces the robot of the catalogue.
        tip: link of the URDF file that is the tool.
        distances: distances of sockets [m], with `*` for the placement.
        other_session: name of the series that the split "session" predicts.
        note: remark for readers, such as which part of the published series the rows are.
    """

    name: str
    title: str
    citation: str
    url: str
    licence: str
    sensor: str
    file: str
    sha256: str
    robot: str
    splits: Mapping[str, str]
    urdf: str | None = None
    tip: str | None = None
    distances: Mapping[tuple[str, str], float] = field(default_factory=dict)
    other_session: str | None = None
    note: str = ""

    def missing(self) -> str | None:
        """Return what must be done before the series can be read; None if the file exists and is complete."""
        path = DATA / self.file
        if not path.is_file():
            return f"{path} is missing: convert {self.url} to a measurement file, or set PISIGMA_DATA to its folder"
        if self.urdf is not None and not (DATA / self.urdf).is_file():
            return f"{DATA / self.urdf} is missing: get it from {self.url}"
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if digest != self.sha256:
            return f"{path} has the SHA-256 {digest}, expected {self.sha256}: get the version of {self.url} again"
        return None

    @cached_property
    def arm(self) -> Robot:
        """The nominal arm."""
        return Robot.load(self.robot) if self.urdf is None else Robot.load(DATA / self.urdf, tip=self.tip)

    @cached_property
    def measurements(self) -> Measurements:
        """All rows of the file, in its order.

        Raises:
            MeasurementError: the file is missing, or has another hash.
        """
        missing = self.missing()
        if missing is not None:
            raise MeasurementError(missing, at=Place(DATA / self.file))
        return Measurements.read_csv(DATA / self.file)

    @property
    def measured(self) -> str:
        """Quantity that the rows contain: "position", "pose" or "socket"."""
        (kind,) = self.measurements.kinds
        return kind

    def rows(self) -> Rows:
        """Return all rows as arrays."""
        data = self.measurements
        tensors = {"position": data.position, "rotation": data.rotation, "temperature": data.temperature}
        arrays = {name: values.numpy() for name, values in tensors.items() if values is not None}
        if data.socket is not None:
            arrays["socket"] = np.array(data.socket)
        return Rows(data.q.numpy(), np.array(data.target), **arrays)

    def known_distances(self, rows: Rows) -> dict[tuple[str, str], float]:
        """Return the known distances between the sockets of some rows [m]."""
        if rows.socket is None:
            return {}
        here = set(rows.socket.tolist())
        known = expand_socket_names(self.distances, self.measurements.socket or ())
        return {pair: length for pair, length in known.items() if here.issuperset(pair)}


def to_measurements(rows: Rows) -> Measurements:
    """Return rows as pisigma's measurements."""
    tensors = {
        name: torch.from_numpy(values) for name, values in rows.arrays().items() if values.dtype == np.float64
    }
    return Measurements(
        tensors["q"],
        position=tensors.get("position"),
        rotation=tensors.get("rotation"),
        temperature=tensors.get("temperature"),
        target=tuple(rows.target.tolist()),
        socket=None if rows.socket is None else tuple(rows.socket.tolist()),
    )

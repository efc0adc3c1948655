"""Joint values of a LeRobot data set as a log for images or touched points."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pisigma.files.errors import MeasurementError, Phrase
from pisigma.files.output_file import check_output, write_atomically
from pisigma.measurement.foreign.lerobot_dataset import STATE, LeRobotDataset, joint_motors
from pisigma.measurement.foreign.lerobot_motors import (
    LeRobotUnits,
    check_values,
    radians_per_unit,
    read_motors,
)


@dataclass(frozen=True)
class JointLog:
    """Joint values of a data set, one row per frame.

    Attributes:
        motors: motors of the columns q1, q2, ..., in their order.
        left_out: names of values that are not positions of these motors.
        header: names of the columns: `image`, `time` and the joint values.
        rows: texts of the rows.
        source: the data set.
    """

    motors: tuple[str, ...]
    left_out: tuple[str, ...]
    header: tuple[str, ...]
    rows: list[list[str]]
    source: str

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a CSV file that `pisigma detect --joints` takes.

        Raises:
            OutputError: the file cannot be written.
        """
        check_output(Path(path), (".csv",), "a file of joint values", [self.source])
        write_atomically(Path(path), "".join(",".join(row) + "\n" for row in (self.header, *self.rows)))

    def to_json(self) -> dict[str, object]:
        """Return the number of rows, the columns, and the names of the values that are left out."""
        columns = {f"q{number}_deg": motor for number, motor in enumerate(self.motors, start=1)}
        return {"rows": len(self.rows), "columns": columns, "left_out": list(self.left_out)}


def read_joint_log(
    dataset: str | os.PathLike[str],
    units: LeRobotUnits | None,
    calibration: str | os.PathLike[str] | None = None,
    prefix: str = "",
) -> JointLog:
    """Read the observed joint values of all frames, without the gripper and other values that are not joint positions.

    Columns are the motors in their order in the data set. `image` is `episode-000003-frame-000120`, the name of the
    image of that frame, and `time` [s] counts from the start of its episode.

    Args:
        dataset: folder of the data set.
        units: units of the values; None if not stated.
        calibration: LeRobot's calibration file, needed for normalized values.
        prefix: start of the names of this arm, such as "left_" for one arm of a pair.

    Raises:
        MeasurementError: the data set cannot be read, has no joint values of this arm, the units of its values are not
            stated, or the values are not possible in these units.
        ImportError: pyarrow is not installed.
    """
    if units is None:
        raise MeasurementError(
            "LeRobot stores degrees, or -100 to 100 over the range of a motor, and the values do not show which",
            option="lerobot_units",
            expected="degrees or normalized",
            remedy="state --set lerobot_units=degrees if they were recorded with use_degrees=true, otherwise "
            "--set lerobot_units=normalized",
        )
    source = LeRobotDataset.open(dataset)
    if STATE not in source.names:
        raise MeasurementError(
            expected=f"the feature {STATE}", value=Phrase(", ".join(source.names)), option="files"
        )
    names = source.names[STATE]
    motors = joint_motors(names, prefix)
    if not motors:
        raise MeasurementError(
            expected="positions of motors", value=Phrase(", ".join(names)), option="lerobot_prefix"
        )
    columns = list(motors.values())
    known = None if calibration is None else read_motors(calibration)
    scale = np.rad2deg([radians_per_unit(units, motor, known) for motor in motors])
    rows = []
    for file, table in source.tables():
        recorded = source.frames(table, STATE, file)[:, columns].astype(np.float64)
        check_values(recorded, units, tuple(motors), known, file)
        values = recorded * scale
        keys = (table.column(name).to_pylist() for name in ("episode_index", "frame_index", "timestamp"))
        for episode, frame, seconds, joints in zip(*keys, values.tolist(), strict=True):
            image = f"episode-{episode:06d}-frame-{frame:06d}"
            rows.append([image, f"{seconds:.6f}", *(f"{value:.6f}" for value in joints)])
    header = ("image", "time", *(f"q{number}_deg" for number in range(1, len(motors) + 1)))
    left_out = tuple(name for index, name in enumerate(names) if index not in columns)
    return JointLog(tuple(motors), left_out, header, rows, str(dataset))

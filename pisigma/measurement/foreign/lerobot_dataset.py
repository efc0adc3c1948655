"""Joint values in LeRobot data sets (v2.1 and v3.0): Parquet files under `data/`, described by `meta/info.json`.

They are read for the correction of a data set, and as a log for images or touched points.
"""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.files.input_file import read_text
from pisigma.files.output_file import check_output, write_atomically
from pisigma.measurement.foreign.lerobot_motors import (
    LeRobotUnits,
    check_values,
    radians_per_unit,
    read_motors,
)

if TYPE_CHECKING:
    import pyarrow

_INFO = Path("meta", "info.json")
_VERSIONS = ("v2.1", "v3.0")
STATE, _ACTION = "observation.state", "action"
_POSITION = ".pos"
"""End of the names of positions; velocities and torques end in ".vel" and ".torque"."""
_GRIPPER, _SHADOW = "gripper", "_shadow"
"""Ends of the names of motors that LeRobot counts as joints although they are not joints of the robot."""
_SIDES = ("left_", "right_")
"""Prefixes of the two arms of LeRobot's pairs."""


def is_lerobot_dataset(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder has the description of a LeRobot data set."""
    return (Path(path) / _INFO).is_file()


@dataclass(frozen=True, eq=False)
class LeRobotDataset:
    """A data set on disk whose frames have not been read yet.

    Attributes:
        folder: folder of the data set.
        version: layout, one of `_VERSIONS`.
        fps: frames per second.
        feature_names: names of the values of every feature of joint values (`STATE`, `_ACTION`), in their order.
        files: Parquet files of the frames, in the order of the episodes.
    """

    folder: Path
    version: str
    fps: float
    feature_names: dict[str, tuple[str, ...]]
    files: tuple[Path, ...]

    @staticmethod
    def open(folder: str | os.PathLike[str]) -> "LeRobotDataset":
        """Read the description of a data set.

        Raises:
            MeasurementError: the description is missing, has an unknown layout, or does not name the joint values.
        """
        at = Place(Path(folder) / _INFO)
        try:
            info = json.loads(read_text(Path(folder) / _INFO, MeasurementError, "JSON"))
            version, fps, features = info["codebase_version"], float(info["fps"]), dict(info["features"])
        except (ValueError, KeyError, TypeError) as problem:
            if isinstance(problem, MeasurementError):
                raise
            reason = (
                f"{problem} is missing" if isinstance(problem, KeyError) else getattr(problem, "msg", problem)
            )
            raise MeasurementError(
                f"the file does not describe a LeRobot data set: {reason}",
                expected="codebase_version, fps and features of a LeRobot data set",
                at=at,
            ) from None
        if version not in _VERSIONS:
            raise MeasurementError(
                expected=f"a data set of layout {' or '.join(_VERSIONS)}",
                value=version,
                at=at,
                remedy="convert it with LeRobot",
            )
        names = {key: _value_names(features[key], key, at) for key in (STATE, _ACTION) if key in features}
        files = tuple(sorted((Path(folder) / "data").glob("chunk-*/*.parquet")))
        if not names or not files:
            missing = f"the feature {STATE} or {_ACTION}" if files else "Parquet files under data/"
            raise MeasurementError(expected=missing, at=at)
        return LeRobotDataset(Path(folder), version, fps, names, files)

    def tables(self) -> "Iterator[tuple[Path, pyarrow.Table]]":
        """Yield the tables of all files, one after the other; see `read_table`."""
        for file in self.files:
            yield file, read_table(file)

    def feature_values(
        self, table: "pyarrow.Table", feature: str, file: Path
    ) -> Float[np.ndarray, "frames values"]:
        """Return the values of a feature in one of the `tables`, (frames, values).

        Raises:
            MeasurementError: the column is missing, or a frame has a different number of values.
        """
        at, count = Place(file, column=feature), len(self.feature_names[feature])
        if feature not in table.column_names:
            raise MeasurementError(expected=f"a column {feature}", at=at)
        values = table.column(feature).combine_chunks()
        flat = values.flatten().to_numpy(zero_copy_only=False)
        if values.null_count or len(flat) != count * len(table):
            raise MeasurementError(expected=f"{count} values in every frame", at=at)
        frames: np.ndarray = flat.reshape(len(table), count)
        return frames


def read_table(file: Path) -> "pyarrow.Table":
    """Read a Parquet file.

    Raises:
        MeasurementError: the file cannot be read.
        ImportError: pyarrow is not installed.
    """
    from pyarrow import ArrowException, parquet

    try:
        return parquet.read_table(file)
    except (ArrowException, OSError) as problem:
        raise MeasurementError(f"the file cannot be read: {problem}", at=Place(file)) from None


def _value_names(feature: Any, key: str, at: Place) -> tuple[str, ...]:
    """Return the names of the values of a feature, which may be in a list or in a dictionary with one list."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise MeasurementError(
            expected=f"names of the values of {key}", value=str(names), at=at, remedy="add them to the file"
        )
    return tuple(names)


def position_indices_of_motors(names: Sequence[str], prefix: str = "") -> dict[str, int]:
    """Return the index of the position of every motor of an arm, by the name of the motor, in the order of the values.

    The positions are the values whose names end in ".pos" ("left_elbow_flex.pos" for motor "elbow_flex"); if there are
    none, as in data sets from before LeRobot 0.2, they are the values whose names contain no dot. The gripper and the
    second motor of a joint (ALOHA's "elbow_shadow") are left out, because they are not joints of the robot.

    Args:
        names: names of the values of a frame.
        prefix: prefix of the motor names of this arm, such as "left_" for one arm of a pair.

    Raises:
        MeasurementError: a motor appears twice, or the values are those of two arms and no prefix is given.
    """
    suffix = _POSITION if any(name.endswith(_POSITION) for name in names) else ""
    motors: dict[str, int] = {}
    for index, name in enumerate(names):
        bare = name.removeprefix("main_").removesuffix(suffix)  # "main_" is older than LeRobot 0.2
        if not name.endswith(suffix) or "." in bare or not bare.startswith(prefix):
            continue
        motor = bare.removeprefix(prefix)
        if motor.endswith((_GRIPPER, _SHADOW)):
            continue
        if motor in motors:
            raise MeasurementError(
                f"motor '{motor}' appears twice",
                value=motor,
                option="names",
                remedy="give the position of every motor once",
            )
        motors[motor] = index
    sides = [side for side in _SIDES if any(motor.startswith(side) for motor in motors)]
    if len(sides) > 1:
        raise MeasurementError(
            "the values are those of two arms",
            expected=f"the prefix of one arm, {' or '.join(sides)}",
            value=", ".join(names),
            option="prefix",
            remedy=f"state prefix={sides[0]} (on a command line: --set lerobot_prefix={sides[0]})",
        )
    return motors


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
        prefix: prefix of the motor names of this arm, such as "left_" for one arm of a pair.

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
    if STATE not in source.feature_names:
        raise MeasurementError(
            expected=f"the feature {STATE}", value=Phrase(", ".join(source.feature_names)), option="files"
        )
    names = source.feature_names[STATE]
    motors = position_indices_of_motors(names, prefix)
    if not motors:
        raise MeasurementError(
            expected="positions of motors", value=Phrase(", ".join(names)), option="lerobot_prefix"
        )
    columns = list(motors.values())
    known = None if calibration is None else read_motors(calibration)
    scale = np.rad2deg([radians_per_unit(units, motor, known) for motor in motors])
    rows = []
    for file, table in source.tables():
        recorded = source.feature_values(table, STATE, file)[:, columns].astype(np.float64)
        check_values(recorded, units, tuple(motors), known, file)
        values = recorded * scale
        keys = (table.column(name).to_pylist() for name in ("episode_index", "frame_index", "timestamp"))
        for episode, frame, seconds, joints in zip(*keys, values.tolist(), strict=True):
            image = f"episode-{episode:06d}-frame-{frame:06d}"
            rows.append([image, f"{seconds:.6f}", *(f"{value:.6f}" for value in joints)])
    header = ("image", "time", *(f"q{number}_deg" for number in range(1, len(motors) + 1)))
    left_out = tuple(name for index, name in enumerate(names) if index not in columns)
    return JointLog(tuple(motors), left_out, header, rows, str(dataset))

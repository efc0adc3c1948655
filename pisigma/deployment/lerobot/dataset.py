"""Correct the joint values of a whole LeRobot data set."""

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pisigma.deployment.lerobot.correction import LeRobotCorrection
from pisigma.files.conflicts import check_conflicts
from pisigma.files.errors import MeasurementError, OutputError, Place
from pisigma.files.input_file import read_text
from pisigma.files.output_file import write_failure
from pisigma.files.scratch import FOLDER, scratch_beside
from pisigma.measurement.foreign.lerobot_dataset import LeRobotDataset, read_table
from pisigma.measurement.foreign.lerobot_motors import LeRobotUnits, check_values

if TYPE_CHECKING:
    import pyarrow

RECORD = Path("meta", "pisigma.json")
"""File in a corrected data set with the version of the model, by prefix of the arm and by feature."""
STATISTICS = ("mean", "min", "max", "q01", "q10", "q50", "q90", "q99")
"""Statistics of a feature that shift with its values, unlike the standard deviation and the count."""


@dataclass(frozen=True, eq=False)
class CorrectedDataset:
    """Result of `correct_lerobot_dataset`.

    Attributes:
        folder: the new data set.
        frames: number of frames.
        corrections: the correction of every changed feature, by name.
    """

    folder: Path
    frames: int
    corrections: dict[str, LeRobotCorrection]


def correct_lerobot_dataset(
    dataset: str | os.PathLike[str],
    model: str | os.PathLike[str],
    out: str | os.PathLike[str],
    units: LeRobotUnits,
    calibration: str | os.PathLike[str] | None = None,
    prefix: str = "",
) -> CorrectedDataset:
    """Write a copy of a data set with true joint values in `observation.state` and `action`.

    Frames keep their shape, type and order; the statistics of these features are shifted accordingly. All other files
    are copied unchanged. `meta/pisigma.json` states the version of the model. A data set of two arms is corrected arm
    by arm: the second call takes the output of the first, with the other prefix.

    Args:
        dataset: folder of a data set of layout v2.1 or v3.0.
        model: model folder of the arm; see `LeRobotCorrection.load`.
        out: folder to write; it must not exist.
        units: units of the joint values.
        calibration: LeRobot's calibration file, needed for normalized values.
        prefix: prefix of the motor names of this arm.

    Raises:
        MeasurementError: the data set cannot be read, this arm has already been corrected, its values are not those of
            the robot, or they are impossible in these units.
        ModelError: the folder is not a model.
        OutputError: the new folder already exists or cannot be written.
        ImportError: pyarrow is not installed.
    """
    source, target = LeRobotDataset.open(dataset), Path(os.path.realpath(out))
    record = _record(source, prefix)
    check_conflicts(out, (source.folder, Path(model)))
    if target.exists():
        raise OutputError(
            "the output already exists", at=Place(out), option="out", remedy="choose another folder"
        )
    corrections = {
        key: LeRobotCorrection.load(model, names, units, calibration, prefix)
        for key, names in source.feature_names.items()
    }
    record[prefix] = {key: one.version for key, one in corrections.items()}
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with scratch_beside(target, FOLDER) as scratch:
            frames = _write_copy(source, corrections, scratch)
            (scratch / RECORD).write_text(json.dumps(record, indent=4))
            scratch.chmod(0o755)
            scratch.rename(target)
    except shutil.Error as problem:  # of `copytree`: a list of file, copy and reason
        file, _, reason = problem.args[0][0]
        raise MeasurementError(f"the file cannot be copied: {reason}", at=Place(file)) from None
    except OSError as problem:
        raise write_failure(out, problem) from None
    return CorrectedDataset(target, frames, corrections)


def _record(source: LeRobotDataset, prefix: str) -> dict[str, Any]:
    """Return the arms of a data set that have already been corrected, by prefix.

    Raises:
        MeasurementError: this arm has already been corrected; a prefix that extends another prefix selects the same
            values.
    """
    path = source.folder / RECORD
    if not path.exists():
        return {}
    record = _json(path, read_text(path, MeasurementError, "JSON"))
    if any(other.startswith(prefix) or prefix.startswith(other) for other in record):
        raise MeasurementError(
            "the data set has already been corrected",
            value=", ".join(map(repr, record)),
            at=Place(path),
            remedy="correct the original data set, or state the prefix of the other arm",
        )
    return record


def _json(path: Path, text: str, line: int | None = None) -> dict[str, Any]:
    """Parse the text of a file as a JSON object.

    Raises:
        MeasurementError: the text is not a JSON object.
    """
    try:
        document = json.loads(text)
    except ValueError as problem:
        raise MeasurementError(
            f"the file is not valid JSON: {getattr(problem, 'msg', problem)}",
            expected="JSON",
            at=Place(path, line),
        ) from None
    if not isinstance(document, dict):
        raise MeasurementError(expected="a JSON object", value=type(document).__name__, at=Place(path, line))
    return document


def _write_copy(source: LeRobotDataset, corrections: dict[str, LeRobotCorrection], folder: Path) -> int:
    """Write all files of a data set to a folder; return the number of frames."""
    from pyarrow import parquet

    changed = {file.relative_to(source.folder) for file in (*source.files, *_episode_files(source))}
    changed |= {Path("meta", name) for name in ("stats.json", "episodes_stats.jsonl")}

    def unchanged(where: str, names: list[str]) -> set[str]:
        return {name for name in names if Path(where, name).relative_to(source.folder) in changed}

    shutil.copytree(source.folder, folder, dirs_exist_ok=True, ignore=unchanged)
    frames = 0
    for file, table in source.tables():
        for key, correction in corrections.items():
            recorded = source.feature_values(table, key, file)
            names = [axis.name for axis in correction.model.robot.axes]
            check_values(
                recorded[:, list(correction.joint_value_indices)],
                correction.units,
                names,
                correction.motors,
                file,
            )
            values = correction.true_values(recorded)
            table = _with_column(table, key, values.reshape(-1))
        parquet.write_table(table, folder / file.relative_to(source.folder))
        frames += len(table)
    for file in _episode_files(source):
        table = _with_statistics(read_table(file), corrections)
        parquet.write_table(table, folder / file.relative_to(source.folder))
    _write_json_statistics(source.folder, corrections, folder)
    return frames


def _episode_files(source: LeRobotDataset) -> list[Path]:
    """Return the files of layout v3.0 with the statistics of every episode."""
    return sorted((source.folder / "meta" / "episodes").glob("chunk-*/*.parquet"))


def _with_column(table: "pyarrow.Table", name: str, flat: Float[np.ndarray, " numbers"]) -> "pyarrow.Table":
    """Return a table with new numbers, of the same type and lengths, in a column of lists."""
    import pyarrow

    index, field = table.column_names.index(name), table.schema.field(name)
    old = table.column(name).combine_chunks()
    numbers = pyarrow.array(flat, field.type.value_type)
    if pyarrow.types.is_fixed_size_list(field.type):
        new = pyarrow.FixedSizeListArray.from_arrays(numbers, type=field.type)
    else:
        new = type(old).from_arrays(old.offsets, numbers, type=field.type)
    return table.set_column(index, field, new)


def _with_statistics(table: "pyarrow.Table", corrections: dict[str, LeRobotCorrection]) -> "pyarrow.Table":
    """Shift the statistics of the corrected features in a table of episodes."""
    for key, correction in corrections.items():
        for name in (f"stats/{key}/{kind}" for kind in STATISTICS):
            if name in table.column_names:
                flat = table.column(name).combine_chunks().flatten().to_numpy(zero_copy_only=False)
                table = _with_column(
                    table, name, (flat.reshape(len(table), -1) + correction.value_offsets).reshape(-1)
                )
    return table


def _write_json_statistics(source: Path, corrections: dict[str, LeRobotCorrection], folder: Path) -> None:
    """Shift the statistics in `stats.json` (of all frames) and `episodes_stats.jsonl` (of every episode, v2.1)."""
    whole, episodes = Path("meta", "stats.json"), Path("meta", "episodes_stats.jsonl")
    if (source / whole).exists():
        document = _json(source / whole, read_text(source / whole, MeasurementError, "JSON"))
        _move(document, corrections)
        (folder / whole).write_text(json.dumps(document, indent=4))
    if (source / episodes).exists():
        text = read_text(source / episodes, MeasurementError, "JSON")
        lines = [_json(source / episodes, line, n) for n, line in enumerate(text.splitlines(), start=1)]
        for line in lines:
            _move(line["stats"], corrections)
        (folder / episodes).write_text("".join(json.dumps(line) + "\n" for line in lines))


def _move(statistics: dict[str, Any], corrections: dict[str, LeRobotCorrection]) -> None:
    """Shift statistics, by feature, in place."""
    for key, correction in corrections.items():
        entry = statistics.get(key, {})
        for kind in set(STATISTICS) & set(entry):
            entry[kind] = (np.array(entry[kind]) + correction.value_offsets).tolist()

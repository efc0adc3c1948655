"""File in a model folder with the errors of all held-out rows, from which a report shows where errors occur."""

import csv
import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import ModelError, Place
from pisigma.files.model_files import HELD_OUT_CSV, read_model_file
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.validation.held_out.calibration_summary import CalibrationSummary, HeldOutFile
from pisigma.validation.held_out.calibration_validation import CalibrationValidation
from pisigma.validation.held_out.pose_statistics import PoseErrors

_RESIDUAL = tuple(f"residual_{axis}_mm" for axis in "xyz")
_DEGREES = float(np.rad2deg(1.0))


@dataclass(frozen=True, eq=False)
class HeldOutRows:
    """Errors of held-out rows, each under calibrations fitted without that row, in the order of the measurements.

    Attributes:
        q: commanded joint values [rad or m].
        frame: frame of every row.
        target: target of every row.
        errors_by_model: lengths [m] and angles [rad] of the errors by model; NaN in rows that were never held out.
        residual: measured minus predicted position under the last model [m], in the row's frame; NaN in rows that were
            never held out, and if it is not stored.
        data_sha256: hash of the measurements.
        line: line of every row in its file; 0 for rows that were not read from a file, or if it is not stored.
        file_name: name of the file of every row if they come from several files; otherwise empty.
    """

    q: Float64[Tensor, "rows dof"]
    frame: tuple[str, ...]
    target: tuple[str, ...]
    errors_by_model: Mapping[str, PoseErrors]
    residual: Float64[Tensor, "rows 3"]
    data_sha256: str
    line: tuple[int, ...] = ()
    file_name: tuple[str, ...] = ()

    @staticmethod
    def from_validation(validation: CalibrationValidation, measurements: Measurements) -> "HeldOutRows":
        """Take the errors of the first repeat of a validation.

        Args:
            validation: the cross-validation.
            measurements: the rows that were validated.
        """
        spread = validation.spread
        residual = torch.full((measurements.rows, 3), torch.nan) if spread is None else spread.error
        return HeldOutRows(
            measurements.q,
            measurements.frame,
            measurements.target,
            validation.errors_by_model,
            residual.double(),
            measurements.content_hash(),
            measurements.line,
            tuple(Path(name).name for name in measurements.origin),
        )

    def to_csv(self, robot: Robot) -> str:
        """Write CSV text with joint values, frame, target, and the errors under every model in mm and deg.

        Columns of coupled joints are named q1_dh_deg and so on, because they are not the controller's values.

        Args:
            robot: the robot, for the units of revolute (deg) and prismatic (mm) joints.
        """
        columns: dict[str, list[str]] = {}
        for j, revolute in enumerate(robot.revolute):
            factor, unit = (_DEGREES, "deg") if revolute else (1e3, "mm")
            columns[f"q{j + 1}_{'dh_' if robot.coupling else ''}{unit}"] = [
                f"{value:.10g}" for value in (self.q[:, j] * factor).tolist()
            ]
        columns |= {"frame": list(self.frame), "target": list(self.target)}
        columns |= {"file": list(self.file_name)} if self.file_name else {}
        columns |= {"line": list(map(str, self.line))} if any(self.line) else {}
        for name, errors in self.errors_by_model.items():
            columns[f"{name}_mm"] = _cells(errors.position * 1e3)
            if errors.rotation is not None:
                columns[f"{name}_deg"] = _cells(errors.rotation * _DEGREES)
        if bool(torch.isfinite(self.residual).any()):
            for axis, name in enumerate(_RESIDUAL):
                columns[name] = _cells(self.residual[:, axis] * 1e3)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
        return text.getvalue()

    def compute_hashes(self, text: str) -> HeldOutFile:
        """Compute the hashes of this text and its measurements, which the metrics of the model store."""
        return HeldOutFile(sha256=hashlib.sha256(text.encode()).hexdigest(), data_sha256=self.data_sha256)


def read_held_out(folder: Path, model: CalibratedModel) -> HeldOutRows | None:
    """Read the file of a model folder; None if the model was made without one.

    Raises:
        ModelError: the file is missing, or is not the one written with the model.
    """
    summary = CalibrationSummary.read(model)
    if summary is None or summary.held_out_rows is None:
        return None
    hashes = summary.held_out_rows
    path = folder / HELD_OUT_CSV
    content = read_model_file(folder, HELD_OUT_CSV)
    if hashlib.sha256(content).hexdigest() != hashes.sha256:
        raise ModelError(
            "the file was changed after the model was written", at=Place(path), remedy="copy the model again"
        )
    head, *rows = csv.reader(io.StringIO(content.decode(), newline=""))
    columns = dict(zip(head, zip(*rows, strict=True), strict=True))
    names = [name.removesuffix("_mm") for name in head if name.endswith("_mm")]
    joints = [name for name in head if name[0] == "q" and name[1:].partition("_")[0].isdigit()]
    q = [_numbers(columns[name]) / (_DEGREES if name.endswith("_deg") else 1e3) for name in joints]
    models = {
        name: PoseErrors(
            _numbers(columns[f"{name}_mm"]) / 1e3,
            _numbers(columns[f"{name}_deg"]) / _DEGREES if f"{name}_deg" in columns else None,
        )
        for name in names
        if f"{name}_mm" not in (*_RESIDUAL, *joints)
    }
    none = torch.full((len(rows), 3), torch.nan, dtype=torch.float64)
    kept = [_numbers(columns[name]) / 1e3 for name in _RESIDUAL if name in columns]
    residual = torch.stack(kept, 1) if kept else none
    frame, target = columns["frame"], columns["target"]
    line, origin = tuple(map(int, columns.get("line", ()))), columns.get("file", ())
    return HeldOutRows(torch.stack(q, 1), frame, target, models, residual, hashes.data_sha256, line, origin)


def _cells(values: Float64[Tensor, " rows"]) -> list[str]:
    return ["" if value != value else f"{value:.5g}" for value in values.tolist()]


def _numbers(cells: tuple[str, ...]) -> Float64[Tensor, " rows"]:
    return torch.tensor([float(cell) if cell else torch.nan for cell in cells], dtype=torch.float64)

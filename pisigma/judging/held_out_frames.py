"""Held-out rows of frames, targets or anchors that the rows calibrated with lack."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.hybrid.result import HybridResult
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.problem.loss import SquaredLoss
from pisigma.judging.trained_calibrations import Result, geometric_result
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot


def with_frames(calibrator: GeometricCalibrator, result: Result, rows: Measurements) -> Result:
    """A calibration that knows the frames of some rows too: their bases alone are fitted to these rows.

    Args:
        calibrator: what gave the geometric calibration.
        result: the calibration; of a hybrid, the bases of either arm are fitted.
        rows: some of whose frames it may not know.

    Raises:
        IdentificationError: there are several targets, or the rows do not tell where the base is in their frame.
    """
    geometric = geometric_result(result)
    missing = set(rows.frame) - set(geometric.bases)
    if not missing:
        return result
    if len(geometric.tools) > 1:
        raise IdentificationError(
            f"frame '{min(missing)}' is held out, which needs a single target, but there are "
            f"{', '.join(sorted(geometric.tools))}; split by joints or by time."
        )
    chosen = torch.tensor([name in missing for name in rows.frame]).nonzero()[:, 0]
    own = rows.select(chosen)
    known = geometric.bases | _bases(calibrator, geometric.robot, own)
    if not isinstance(result, HybridResult):
        return replace(result, bases=known)
    learned = result.learned
    if learned is not None:
        with torch.no_grad():
            moved = replace(own, q=own.q + learned.correction.of_rows(own))
        bases = learned.geometry.bases | _bases(calibrator, learned.geometry.robot, moved)
        learned = replace(learned, geometry=replace(learned.geometry, bases=bases))
    return replace(result, geometric=replace(geometric, bases=known), learned=learned)


def _bases(
    calibrator: GeometricCalibrator, robot: Robot, rows: Measurements
) -> dict[str, Float64[np.ndarray, " 6"]]:
    """Where an arm stands in the frames of some rows; every row counts in full."""
    frames = set(rows.frame)
    apart = replace(
        calibrator,
        robot=robot,
        free=(),
        base="free",
        tool="fixed",
        loss=SquaredLoss(),
        frames={name: base for name, base in calibrator.frames.items() if name in frames},
        socket_distances={},
    )
    return apart.fit(rows).bases


def judgeable(measurements: Measurements, test: Tensor, seen: Measurements) -> Tensor:
    """Which test rows have a target, and an anchor or its place, that the training rows have too.

    Args:
        measurements: all rows.
        test: numbers of the test rows.
        seen: the training rows.

    Raises:
        IdentificationError: none has.
    """
    targets, anchors = set(seen.target), {*(seen.anchor or ()), ""}
    names = measurements.anchor or ("",) * measurements.rows
    place = measurements.anchor_place
    placed = torch.zeros(len(test), dtype=torch.bool) if place is None else place[test].isfinite().all(-1)
    rows = test.tolist()
    found = [
        measurements.target[row] in targets and (names[row] in anchors or known)
        for row, known in zip(rows, placed.tolist(), strict=True)
    ]
    if not any(found):
        raise IdentificationError(
            f"{measurements.place(rows[0])}: neither this row nor any other that is held out with it has a target and "
            "an anchor that other rows have; measure more poses with each, or leave out the cross-validation."
        )
    return torch.tensor(found, device=test.device)

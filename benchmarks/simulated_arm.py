"""The independent simulator of arms (`sim.py`), and the true errors of models of its arms."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows


def import_simulator(folder: Path) -> Any:
    """Import `sim.py` from its folder."""
    sys.path.insert(0, str(folder.resolve()))
    return importlib.import_module("sim")


def position_error(model: CalibratedModel, q: np.ndarray, x: np.ndarray) -> float:
    """Return the RMS position error of a model, with its newest base and tool, after a rigid fit [mm].

    Args:
        model: the model.
        q: joint values of the poses [rad or m], shape (poses, dof).
        x: true positions [m], shape (poses, 3).
    """
    frame, target = (([*names] or [""])[-1:] * len(q) for names in (model.bases, model.tools))
    rows = Measurements(
        q=torch.from_numpy(q), position=torch.from_numpy(x), frame=tuple(frame), target=tuple(target)
    )
    return rms_after_fit(poses_of_rows(model, rows)[:, :3, 3].numpy(), x)


def rms_after_fit(positions: np.ndarray, x: np.ndarray) -> float:
    """Return the RMS distance of positions from the true ones [m] after a rigid fit [mm]."""
    a, b = positions - positions.mean(0), x - x.mean(0)
    turn, _ = Rotation.align_vectors(b, a)
    return float(np.sqrt(((turn.apply(a) - b) ** 2).sum(1).mean()) * 1e3)

"""Check written models: a folder is read and compared with the model in memory before it gets its final name."""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from pisigma.files.errors import ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.loading import load

_PROBES = 20
"""Number of joint vectors at which the model in memory and the model in the folder are compared."""
_PROBE_RADIUS = 0.1
"""Largest distance [rad or m] of the compared joint values from the joint values of training rows."""
TOLERANCE, _JOINT_TOLERANCE = 1e-12, 1e-9
"""Largest difference of predictions [m or rad], and of joint values, which are results of an iteration."""


def write_model(model: CalibratedModel, folder: Path) -> None:
    """Write the files of a model into a scratch folder, and check that they load as the same model.

    Raises:
        ModelError: see `save_model`.
        AssertionError: the folder does not load or differs from the model, which is a defect of pisigma.
    """
    save_model(model, folder)
    check_written(model, folder)


def check_written(model: CalibratedModel, folder: Path) -> None:
    """Compare a model with its folder in poses, corrected IK, predicted deviations and prior scales of weights.

    Raises:
        AssertionError: the model and its folder differ.
    """
    try:
        loaded, ik = load_model(folder), load(folder)
    except ModelError as problem:
        raise AssertionError(f"the folder that was just written cannot be read: {problem}") from problem
    rows = _probe(model)
    with torch.no_grad():
        _check("poses", poses_of_rows(model, rows), poses_of_rows(loaded, rows), TOLERANCE)
        T = model.forward(rows.q)
    _check("predicted deviations", sigma_of_rows(model, rows), sigma_of_rows(loaded, rows), TOLERANCE)
    _check("prior scales of weights", _prior_scales(model), _prior_scales(loaded), 0.0)
    finite = T[torch.isfinite(T).flatten(1).all(1)].numpy()
    before, after = CorrectedIK(model)(finite, throw=False), ik(finite, throw=False)
    _check("joint values", torch.as_tensor(before.q), torch.as_tensor(after.q), _JOINT_TOLERANCE)
    _check("statuses", torch.as_tensor(before.status).double(), torch.as_tensor(after.status).double(), 0.0)


def _prior_scales(model: CalibratedModel) -> Tensor:
    """Return the index and the usual value of the prior standard deviation of every weight, which limits its drift."""
    rows = [torch.zeros(0, 2, dtype=torch.float64)]
    for feature in model.uncertainty.features if model.uncertainty else ():
        number = feature.group[feature.used]
        rows.append(torch.stack([number.double(), torch.tensor(feature.usual_sizes).double()[number]], 1))
    return torch.cat(rows)


def _probe(model: CalibratedModel) -> Measurements:
    """Return rows near the training rows, in all frames and for all targets, with approach and conditions."""
    generator = torch.Generator().manual_seed(0)
    starts = model.starts.double().cpu()
    if not len(starts):
        starts = torch.zeros(1, model.robot.dof, dtype=torch.float64)
    numbers = torch.linspace(0, len(starts) - 1, _PROBES).round().long()
    around = 2 * torch.rand((_PROBES, model.robot.dof), generator=generator, dtype=torch.float64) - 1
    frames, targets = list(model.bases) or [""], list(model.tools) or [""]
    rows = Measurements(
        q=starts[numbers] + _PROBE_RADIUS * around,
        frame=tuple(frames[k % len(frames)] for k in range(_PROBES)),
        target=tuple(targets[k // len(frames) % len(targets)] for k in range(_PROBES)),
    )
    return replace(
        rows,
        approach=2.0 * torch.randint(0, 2, rows.q.shape, generator=generator).double() - 1.0,
        payload=torch.linspace(0.0, 5.0, _PROBES, dtype=torch.float64),
        temperature=torch.linspace(15.0, 30.0, _PROBES, dtype=torch.float64),
        torque=20.0 * torch.rand(rows.q.shape, generator=generator, dtype=torch.float64) - 10.0,
    )


def _check(what: str, before: Tensor, after: Tensor, tolerance: float) -> None:
    """Check that values are equal within a tolerance; NaN equals NaN."""
    same = torch.isclose(before, after, rtol=0.0, atol=tolerance, equal_nan=True)
    if before.shape != after.shape or not bool(same.all()):
        most = float((before - after).abs().nan_to_num(torch.inf).max())
        raise AssertionError(
            f"{what} of the model in the folder differ by {most:.3g} from those of the model in memory"
        )

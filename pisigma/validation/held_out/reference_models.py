"""Reference models for comparisons: the nominal robot, and the geometric calibration of a hybrid."""

from dataclasses import replace

import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError, ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.validation.held_out.trained_calibrations import base_and_tool_calibrator


def nominal_model(model: CalibratedModel, with_orientation: bool) -> CalibratedModel:
    """Return a model of the nominal robot, with base and tool fitted to the predictions of a model.

    Base and tool of an identified geometry belong to that geometry and would increase the errors of the nominal arm.
    Therefore they are fitted again, to the target poses that the model predicts at its stored joint values of training
    rows; the rows under test are not used. A model with nominal geometry already has such a base and tool.

    Args:
        model: a model of any kind.
        with_orientation: whether orientations are compared, and therefore also fitted.

    Raises:
        ModelError: the model does not store enough joint values to fit base and tool.
    """
    if model.calibrated is None:
        return replace(model, network=None, domain=None)
    try:
        fitted = base_and_tool_calibrator(GeometricCalibrator(model.robot)).fit(
            _predicted(model, with_orientation)
        )
    except IdentificationError as problem:
        raise ModelError(
            f"model '{model.name}': the base and tool of the nominal robot cannot be fitted to the "
            f"{len(model.starts)} stored joint vectors of the model ({' '.join(str(problem).rstrip('.').split())})",
            value=len(model.starts),
            remedy="evaluate two or more model folders, without 'nominal'",
        ) from problem
    robot = model.robot.with_geometry(base=fitted.robot.base, tool=fitted.robot.tool)
    return replace(
        geometric_model(model),
        robot=robot,
        calibrated=robot,
        bases=dict(fitted.bases),
        tools=dict(fitted.tools),
    )


def geometric_model(model: CalibratedModel) -> CalibratedModel:
    """Return the geometric calibration on which a hybrid is based; a model without hybrid is returned unchanged.

    Raises:
        ModelError: the model has no identified geometry.
    """
    if model.calibrated is None:
        raise ModelError(
            f"model '{model.name}' ({model.kind}) has no identified geometry",
            value=model.kind,
            remedy="calibrate with `pisigma calibrate`",
        )
    return replace(
        model,
        kind="geometric_calibration",
        network=None,
        domain=None,
        hybrid=None,
        hybrid_bases={},
        hybrid_tools={},
        uncertainty=None,
    )


def _predicted(model: CalibratedModel, turned: bool) -> Measurements:
    """Return predicted rows at stored joint values: all frames with the first target, and all other targets."""
    frames, targets = tuple(model.bases) or ("",), tuple(model.tools) or ("",)
    pairs = [(frame, targets[0]) for frame in frames] + [(frames[0], target) for target in targets[1:]]
    count = len(model.starts)
    rows = Measurements(
        q=model.starts.repeat(len(pairs), 1),
        frame=tuple(frame for frame, _ in pairs for _ in range(count)),
        target=tuple(target for _, target in pairs for _ in range(count)),
        source=model.name,
    )
    with torch.no_grad():
        T = poses_of_rows(model, rows)
    rotation = T[:, :3, :3].contiguous() if turned else None
    return replace(rows, position=T[:, :3, 3].contiguous(), rotation=rotation)

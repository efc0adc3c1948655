"""The model that an adaptation to new rows makes of a model."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.lifetime.recalibration.adaptation import Adaptation
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.geometric_model import branches_of
from pisigma.model.row_poses import Frames
from pisigma.model.stored_starts import spread_rows
from pisigma.model.training_rows import kept_rows
from pisigma.robot.se3 import invert, transform_from_xyzrpy, xyzrpy_from_transform

KIND = "recalibration"


def recalibrated_model(model: CalibratedModel, adaptation: Adaptation, rows: Measurements) -> CalibratedModel:
    """Make the model that new rows were added to; it has a posterior again.

    The geometric calibration that a hybrid keeps beside its own geometry is taken along: its parameters change by as
    much, and its bases and tools are moved as those of the hybrid are.

    Args:
        model: as it was.
        adaptation: of it to the rows.
        rows: the rows.
    """
    known, drawn = model.uncertainty, model.drawn
    assert known is not None
    assert drawn is not None
    solved = adaptation.arm.geometry
    geometry = IdentifiedGeometry(solved.robot, solved.bases, solved.tools, solved.unknowns)
    calibrated, bases, tools = geometry.robot, geometry.bases, geometry.tools
    starts = spread_rows(torch.unique(torch.cat([model.starts.double(), rows.q.cpu()]), dim=0))
    hybrid = None
    if model.hybrid is not None and adaptation.arm.correction is not None:
        assert model.calibrated is not None
        coverage = model.hybrid.coverage.with_rows(rows.q)
        hybrid = HybridArm(geometry.robot, adaptation.arm.correction, coverage)
        bases = _taken_along(model.bases, model.hybrid_bases, geometry.bases, before=True)
        tools = _taken_along(model.tools, model.hybrid_tools, geometry.tools, before=False)
        dh = model.calibrated.dh + geometry.robot.dh - model.hybrid.robot.dh
        calibrated = drawn.with_geometry(
            dh=dh, base=next(iter(bases.values())), tool=next(iter(tools.values()))
        )
    robot = drawn.with_geometry(base=calibrated.base, tool=calibrated.tool)
    root = CovarianceRoot(adaptation.root)
    space = adaptation.problem.design.problem.space
    noise = {**known.noise, **adaptation.noise}
    return replace(
        model,
        kind=KIND,
        robot=robot,
        branches=branches_of(robot, starts),
        starts=starts,
        calibrated=calibrated,
        bases=bases,
        tools=tools,
        hybrid=hybrid,
        hybrid_bases=geometry.bases if hybrid else {},
        hybrid_tools=geometry.tools if hybrid else {},
        uncertainty=PositionUncertainty(space, geometry, known.features, root, known.prior_scale, noise),
        made_of=kept_rows(drawn, rows, model.made_of),
        provenance=Provenance(
            data_source=rows.file_names,
            data_sha256=rows.content_hash(),
            rows=rows.rows,
            rows_left_out=len(rows.left_out),
            versions=Provenance.present_versions(),
        ),
    )


def _taken_along(frames: Frames, from_: Frames, onto: Frames, before: bool) -> Frames:
    """Frames moved as others are; those that are new are as the others.

    Args:
        frames: to be moved.
        from_: the others as they were.
        onto: the others as they are.
        before: whether the motion stands before the frame, as that of a base, or behind it.
    """
    T = {name: _transforms(those) for name, those in (("own", frames), ("from", from_), ("onto", onto))}
    moved: Frames = {}
    for name, there in T["onto"].items():
        if name not in T["own"]:
            moved[name] = onto[name]
            continue
        own, was = T["own"][name], T["from"][name]
        taken = there @ invert(was) @ own if before else own @ invert(was) @ there
        moved[name] = xyzrpy_from_transform(taken).numpy()
    return moved


def _transforms(frames: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {
        name: transform_from_xyzrpy(torch.from_numpy(np.asarray(frame))) for name, frame in frames.items()
    }

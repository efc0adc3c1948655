"""Model made from a parent model and its adaptation to new rows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.lifetime.recalibration.adaptation import Adaptation
from pisigma.lifetime.recalibration.candidates import CandidateChoice
from pisigma.lifetime.recalibration.motion import excessive_change_diagnostics
from pisigma.lifetime.recalibration.movement import Movement
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Frames, Provenance
from pisigma.model.geometric_model import branches_of
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.model.stored_starts import spread_rows
from pisigma.model.training_rows import stored_training_rows
from pisigma.robot.robot_class import plausible_share
from pisigma.robot.se3 import invert, transform_from_xyzrpy, xyzrpy_from_transform
from pisigma.validation.checks.mixed_rows import MIN_WRONG_SHARE, too_many_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.pose_statistics import image_deviation

KIND = "recalibration"
_SUSPICIOUS_FACTOR = 5.0
"""Ratio of the errors of held-out rows to the scatter of positions in the calibration that is suspicious."""


def recalibrated_model(model: CalibratedModel, adaptation: Adaptation, rows: Measurements) -> CalibratedModel:
    """Return the recalibrated model, which also stores a posterior.

    The geometric calibration that a hybrid stores in addition to the hybrid's geometry is updated as well: its
    parameters change by the same amounts, and its bases and tools move as those of the hybrid do.

    Args:
        model: parent model.
        adaptation: adaptation of the parent to the rows.
        rows: new rows.
    """
    known, nominal = model.uncertainty, model.nominal
    assert known is not None
    assert nominal is not None
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
        calibrated = nominal.with_geometry(
            dh=dh, base=next(iter(bases.values())), tool=next(iter(tools.values()))
        )
    robot = nominal.with_geometry(base=calibrated.base, tool=calibrated.tool)
    root = CovarianceRoot(adaptation.root)
    space = adaptation.problem.design.problem.space
    noise = known.noise.updated(adaptation.noise)
    uncertainty = PositionUncertainty(space, geometry, known.features, root, known.prior_scale, noise)
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
        uncertainty=uncertainty.with_rounded_root(rows),
        training_values=stored_training_rows(nominal, rows, model.training_values),
        provenance=Provenance(
            data_source=rows.file_names,
            data_sha256=rows.content_hash(),
            rows=rows.rows,
            rows_left_out=len(rows.left_out),
            versions=Provenance.installed_versions(),
        ),
    )


def _taken_along(frames: Frames, from_: Frames, onto: Frames, before: bool) -> Frames:
    """Move frames as the reference frames of the same names; frames without counterpart are copied from the reference.

    Args:
        frames: frames to move.
        from_: reference frames before the motion.
        onto: reference frames after the motion.
        before: whether the motion multiplies from the left, as for a base, or from the right.
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


def recalibration_diagnostics(
    parent: CalibratedModel,
    judged: CandidateChoice,
    rows: Measurements,
    adaptation: Adaptation,
    wrong: Sequence[int],
    moved: Sequence[Movement],
) -> tuple[Diagnostic, ...]:
    """Return findings that state why the result is implausible although the checks of the rows found nothing.

    Args:
        parent: model that was recalibrated.
        judged: errors of held-out rows.
        rows: all rows.
        adaptation: adaptation of the model to the rows that were not left out.
        wrong: indices of the rows that were left out.
        moved: movements that were found.
    """
    if len(wrong) > MIN_WRONG_SHARE * rows.rows:
        chosen = torch.zeros(rows.rows, dtype=torch.bool)
        chosen[list(wrong)] = True
        return (too_many_wrong_rows(rows, chosen),)
    if judged.kept == "scratch" and (
        implausible := check_rows(rows, parent.nominal or parent.robot).implausible
    ):
        return implausible
    return (*_large_errors(parent, judged, adaptation), *excessive_change_diagnostics(parent.robot, moved))


def _large_errors(
    parent: CalibratedModel, judged: CandidateChoice, adaptation: Adaptation
) -> tuple[Diagnostic, ...]:
    """Return a finding if no candidate predicts the held-out rows."""
    error, share = judged.rms[judged.kept], plausible_share(parent.robot)
    if error is None:
        return ()
    noise = (
        math.nan if parent.uncertainty is None else parent.uncertainty.noise.standard_deviation("position")
    )
    setup = adaptation.problem.setup
    rows = setup.weighted_rows(setup.measurements, adaptation.arm.geometry)
    usual = max(math.sqrt(3) * (0.0 if math.isnan(noise) else noise), image_deviation(rows))
    missed = f"{rows.source}: the RMS error of held-out rows is {error * 1e3:.3g} mm"
    if error > share * parent.robot.reach:
        sentence = (
            f"{missed}, more than {100 * share:.0f} % of the reach of robot '{parent.robot.name}': another "
            "robot was measured, or columns or units are wrong; run `pisigma verify` on these rows."
        )
    elif error > _SUSPICIOUS_FACTOR * usual > 0 and parent.kind != FLEET_PRIOR:
        sentence = (
            f"{missed}, while single positions scattered by {usual * 1e3:.2g} mm when the model was made: rows may be "
            "wrong or from another robot, or more has changed than these few rows can determine. Check the rows with "
            "`pisigma verify`, or measure more of them."
        )
    else:
        return ()
    return (Diagnostic(kind="residual", severity="implausible", sentence=sentence),)

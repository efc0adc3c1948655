"""A geometric calibration as a model that corrected inverse kinematics can be made from."""

import platform
from importlib.metadata import version
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel, Provenance
from pisigma.correction.identified_arm import IdentifiedArm
from pisigma.correction.stored_starts import StoredStarts, spread_rows
from pisigma.identification.result import CalibrationResult
from pisigma.kinematics.closed_form import closed_form_solver
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot


def model_of_calibration(
    name: str,
    nominal: Robot,
    result: CalibrationResult,
    measurements: Measurements,
    recipe: tuple[str, str] = ("", ""),
) -> CalibratedModel:
    """Make the model of a geometric calibration.

    Its poses are those of the first target in the first frame of the measurements. Nominal joint values are
    those of the nominal arm on the base and with the tool that were identified.

    Args:
        name: of the model.
        nominal: the robot as drawn.
        result: its calibration.
        measurements: the rows it was calibrated with.
        recipe: name and SHA-256 of the recipe, where there was one.
    """
    robot = nominal.with_geometry(base=result.robot.base, tool=result.robot.tool)
    starts = spread_rows(torch.unique(measurements.q.cpu(), dim=0))
    return CalibratedModel(
        name=name,
        kind="geometric_calibration",
        robot=robot,
        network=None,
        domain=None,
        branches=_branches(robot, result.robot, starts),
        starts=starts,
        calibrated=result.robot,
        bases=dict(result.bases),
        tools=dict(result.tools),
        provenance=Provenance(
            recipe=recipe[0],
            recipe_sha256=recipe[1],
            data_source=Path(measurements.source).name,
            data_sha256=measurements.content_hash(),
            rows=measurements.rows,
            rows_left_out=len(measurements.left_out),
            versions={name: version(name) for name in ("pisigma", "torch")}
            | {"python": platform.python_version()},
        ),
    )


def _branches(nominal: Robot, calibrated: Robot, q: Float64[Tensor, "rows dof"]) -> tuple[str, ...]:
    """Branches of the nominal arm that joint values lie on, most frequent first; empty without closed form."""
    solver = closed_form_solver(nominal)
    if solver is None:
        return ()
    index = IdentifiedArm(nominal, calibrated, solver, StoredStarts(calibrated, q)).branch_of(q)
    counts = torch.bincount(index, minlength=len(solver.branches))
    order = counts.argsort(descending=True, stable=True).tolist()
    return tuple(solver.branches[i] for i in order if counts[i] > 0)

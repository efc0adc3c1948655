"""Make calibrated models from the results of geometric and hybrid calibrations."""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.stored_starts import evenly_spaced_rows, nearest_branch
from pisigma.model.training_rows import stored_training_rows
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver


def model_of_calibration(
    name: str,
    nominal: Robot,
    result: CalibrationResult,
    measurements: Measurements,
    recipe: tuple[str, str] = ("", ""),
) -> CalibratedModel:
    """Return the model of a geometric calibration.

    The model predicts poses of the first target in the first frame of the measurements. Nominal joint values refer
    to the nominal arm with the identified base and tool.

    Args:
        name: name of the model.
        nominal: nominal robot.
        result: calibration of the robot.
        measurements: rows with which the robot was calibrated.
        recipe: name and SHA-256 of the recipe; empty texts if there is none.
    """
    training_values = stored_training_rows(nominal, measurements)
    provenance = Provenance(
        recipe=recipe[0],
        recipe_sha256=recipe[1],
        data_source=measurements.file_names,
        data_sha256=measurements.content_hash(),
        rows=measurements.rows,
        rows_left_out=len(measurements.left_out),
        versions=Provenance.installed_versions(),
    )
    robot = nominal.with_geometry(base=result.robot.base, tool=result.robot.tool)
    starts = evenly_spaced_rows(torch.unique(measurements.q.cpu(), dim=0))
    return CalibratedModel(
        name=name,
        kind="geometric_calibration",
        robot=robot,
        network=None,
        domain=None,
        branches=branches_of(robot, starts),
        starts=starts,
        calibrated=result.robot,
        bases=dict(result.bases),
        tools=dict(result.tools),
        training_values=training_values,
        provenance=provenance,
    )


def model_of_hybrid(
    name: str,
    nominal: Robot,
    result: HybridResult,
    measurements: Measurements,
    recipe: tuple[str, str] = ("", ""),
) -> CalibratedModel:
    """Return the model of a hybrid calibration, or of its geometric part if no joint correction was learned.

    The arguments are those of `model_of_calibration`.
    """
    model = model_of_calibration(name, nominal, result.geometric, measurements, recipe)
    return with_hybrid(model, result, measurements)


def with_hybrid(model: CalibratedModel, result: HybridResult, measurements: Measurements) -> CalibratedModel:
    """Return the model of a geometric part with joint correction and uncertainty of the hybrid calibration."""
    known, learned = result.geometric, result.learned
    uncertainty = result.uncertainty.with_rounded_root(measurements)
    if learned is None:
        geometry = IdentifiedGeometry(known.robot, model.bases, model.tools, known.sensor_unknowns)
        return replace(model, uncertainty=replace(uncertainty, geometry=geometry))
    bases, tools = dict(learned.geometry.bases), dict(learned.geometry.tools)
    geometry = IdentifiedGeometry(learned.geometry.robot, bases, tools, learned.geometry.unknowns)
    return replace(
        model,
        kind="hybrid_calibration",
        hybrid=result.arm(),
        hybrid_bases=bases,
        hybrid_tools=tools,
        uncertainty=replace(uncertainty, geometry=geometry),
    )


def branches_of(nominal: Robot, q: Float64[Tensor, "rows dof"]) -> tuple[str, ...]:
    """Return the names of the nominal arm's branches at joint values, most frequent first; () without a closed form."""
    solver = closed_form_solver(nominal)
    return () if solver is None else solver.most_frequent_branches(nearest_branch(solver, q))

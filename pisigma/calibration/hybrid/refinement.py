"""Fit the selected model to all rows; linearisation and posterior alternate until they agree."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.identifiability.sufficiency import floating_frames
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry, identified_geometry
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.design import (
    AbstractDesignRegression,
    Design,
    LinearisedRows,
    chunks,
    robust_weights,
)
from pisigma.calibration.hybrid.regression import build_regression
from pisigma.calibration.hybrid.search import FeatureChoice
from pisigma.calibration.hybrid.sensor_values import Shift, sensor_values
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.robot.se3 import transform

MAX_LINEARISATIONS = 5
CONVERGENCE_TOLERANCE = 0.05
"""Squared difference of linearised and true weighted residuals at convergence [variances], per effective unknown."""
ARM = 0.1
"""Distance from the tool's origin, as a share of the reach, of further points that are fitted, so that rotations are
included."""


@dataclass(frozen=True, eq=False)
class RefinedFit:
    """A hybrid model fitted to all rows.

    Attributes:
        rows: the rows, as last linearised and weighted.
        design: design of all unknowns.
        posterior: posterior of the unknowns.
        regression: regression of the rows on the unknowns.
        point: all parameters of the problem.
        correction: the joint correction.
        rounds: number of linearisations.
        held_out_errors: held-out predictions of the folds of the search; None if the model was fitted again after it.
    """

    rows: LinearisedRows
    design: Design
    posterior: Posterior
    regression: AbstractDesignRegression
    point: Float64[Tensor, " parameters"]
    correction: JointCorrection
    rounds: int
    held_out_errors: HeldOutErrors | None = None


def refine(problem: CalibrationProblem, group: Int64[Tensor, " rows"], choice: FeatureChoice) -> RefinedFit:
    """Return the selected features fitted to all rows.

    Args:
        problem: problem of all rows.
        group: see `Rows.group`.
        choice: the selected features, fitted to some or all of the rows.
    """
    design, posterior = Design(problem, choice.best.design.features), choice.best.posterior
    rows, fit, rounds = choice.rows, choice.regression, 1
    while rounds < MAX_LINEARISATIONS:
        there = linearise_rows(design, posterior.x, posterior.effective_unknowns, group)
        differs = there.squared_difference(rows, posterior.x, design, posterior.noise)
        if differs < CONVERGENCE_TOLERANCE * posterior.effective_unknowns:
            break
        rows, fit = there, None  # keep only one system of equations in memory, because they are large
        fit = build_regression(design, there)
        posterior = fit.maximise_evidence(posterior.prior, posterior.noise)
        rounds += 1
    refined = _refined(rows, design, posterior, fit or build_regression(design, rows), rounds)
    return replace(refined, held_out_errors=choice.best.held_out_errors) if rounds == 1 else refined


def _refined(
    rows: LinearisedRows, design: Design, posterior: Posterior, fit: AbstractDesignRegression, rounds: int
) -> RefinedFit:
    problem = design.problem
    point = problem.prior_mean.index_add(0, problem.active, posterior.x[: design.active_count])
    return RefinedFit(
        rows, design, posterior, fit, point, correction_from_weights(design, posterior.x), rounds
    )


def correction_from_weights(design: Design, x: Float64[Tensor, " unknowns"]) -> JointCorrection:
    """Return the joint correction with the weights of given unknowns; products of inputs become product units."""
    features = [chosen for chosen in design.features if not isinstance(chosen, InputProducts)]
    factors, linear = None, []
    for number, chosen in enumerate(design.features):
        weights = x[design.weights_of(number)].cpu()
        if isinstance(chosen, InputProducts):
            factors = chosen.factors(weights)
        else:
            linear.append(torch.zeros(chosen.used.shape).to(weights).masked_scatter(chosen.used, weights))
    orders = () if factors is None else (2,) * (factors.shape[1] // 2)
    made = JointCorrection(design.problem.space.robot, features, orders)
    with torch.no_grad():
        for parameter, values in zip(made.linear, linear, strict=True):
            parameter.copy_(values)
        if factors is not None:
            made.weight.copy_(factors)
    made.requires_grad_(False)
    return made


def chunked_correction(correction: JointCorrection) -> Shift:
    """Return a function that evaluates the correction for many rows in chunks, to limit the memory."""
    return lambda state: torch.cat([correction(state[rows]) for rows in chunks(len(state.q))])


def linearise_rows(
    design: Design, x: Float64[Tensor, " unknowns"], effective_unknowns: float, group: Int64[Tensor, " rows"]
) -> LinearisedRows:
    """Return all rows linearised at given unknowns, with robust weights from their residuals.

    Args:
        design: design of the unknowns.
        x: the unknowns, with parameters relative to nominal.
        effective_unknowns: effective number of unknowns.
        group: see `Rows.group`.
    """
    problem = design.problem
    point = problem.prior_mean.index_add(0, problem.active, x[: design.active_count])
    values = sensor_values(
        problem, point, chunked_correction(correction_from_weights(design, x)) if design.features else None
    )
    return LinearisedRows.from_linearisation(
        design, x, values, robust_weights(problem, values, effective_unknowns), group
    )


def with_aligned_frames(solved: SolvedCalibration, refined: RefinedFit) -> IdentifiedGeometry:
    """Return the geometry of the hybrid, with floating frames moved onto those of the geometric calibration.

    Residuals of sockets, and of distances from anchors at unknown points, do not change if the whole frame is moved.
    However, nominal joint values and predictions of both calibrations must refer to the same base. Therefore every such
    frame is moved so that the poses of the hybrid are nearest to the geometric ones.

    Args:
        solved: the geometric calibration.
        refined: the hybrid calibration.
    """
    setup, rows = solved.setup, solved.measurements
    geometry = identified_geometry(setup, refined.point)
    frames = floating_frames(setup)
    if not frames:
        return geometry
    with torch.no_grad():
        moved = replace(rows, q=rows.q + refined.correction.for_rows(rows))
    points = _points(geometry, moved), _points(solved.geometry, rows)
    bases = setup.reference_frames.bases.clone()
    for frame in frames:
        here = torch.tensor([name == frame for name in rows.frame])
        motion = fit_rigid_motion(points[0][here].flatten(0, 1), points[1][here].flatten(0, 1))
        number = setup.problem.space.frames.index(frame)
        bases[number] = motion.to(bases) @ bases[number]
    return identified_geometry(
        replace(setup, reference_frames=replace(setup.reference_frames, bases=bases)), refined.point
    )


def fit_rigid_motion(
    points: Float64[Tensor, "points 3"], onto: Float64[Tensor, "points 3"]
) -> Float64[Tensor, "4 4"]:
    """Compute the rigid motion T that minimises `Σ |T p - p'|²` (Kabsch 1976, Acta Crystallographica A32, 922-923)."""
    middle, middle_onto = points.mean(0), onto.mean(0)
    U, _, V = torch.linalg.svd((onto - middle_onto).t() @ (points - middle))
    turned = torch.ones(3, dtype=points.dtype, device=points.device)
    turned[2] = torch.linalg.det(U @ V)  # a determinant of -1 would be a reflection
    R = U @ (turned[:, None] * V)
    return transform(R, middle_onto - R @ middle)


def _points(geometry: IdentifiedGeometry, rows: Measurements) -> Float64[Tensor, "rows 4 3"]:
    """Return the tool's origin and a point along each of its axes, in the frame of the row [m]."""
    T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, rows)
    origin = T[:, None, :3, 3]
    return torch.cat([origin, origin + ARM * geometry.robot.reach * T[:, :3, :3].mT], 1)

"""Solve the chosen model on all rows: weights, linearisation and posterior in turn until they agree."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.hybrid.alternating_products import AlternatingProducts
from pisigma.hybrid.design import Design, Rows, sum_up, weigh
from pisigma.hybrid.evidence import Posterior, Sums, maximise_evidence, renewed_noise, solve_posterior
from pisigma.hybrid.products import ProductFit
from pisigma.hybrid.search import Additive
from pisigma.hybrid.sensor_values import sensor_values
from pisigma.identification.identifiability.sufficiency import floating_frames
from pisigma.identification.prediction import predicted_poses
from pisigma.identification.problem.loss import AbstractLoss
from pisigma.identification.problem.setup import IdentifiedGeometry, identified_geometry
from pisigma.identification.result import SolvedCalibration
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.se3 import transform, transform_from_xyzrpy, xyzrpy_from_transform

MOST_ROUNDS = 5
SETTLED = 0.02
"""[standard deviations] Rounds end when no unknown moves by more, on average."""
PRODUCT_CONFIGURATIONS = 3_000
"""Factors of product units are solved for on so many configurations at most."""
ARM = 0.1
"""Points of the tool at this share of the reach from its origin are met as well, so that rotations count."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A solved hybrid.

    Attributes:
        rows: as last linearised and weighted.
        design: all unknowns, the free factors of product units last.
        posterior: of them.
        sums: normal equations of the rows.
        point: all parameters of the problem.
        correction: the network.
        rounds: linearisations made.
    """

    rows: Rows
    design: Design
    posterior: Posterior
    sums: Sums
    point: Float64[Tensor, " parameters"]
    correction: JointCorrection
    rounds: int

    @property
    def effective(self) -> float:
        """Number of unknowns that the data determine."""
        return float(self.posterior.determined.sum())


def refine(
    solved: SolvedCalibration, additive: Additive, orders: tuple[int, ...], loss: AbstractLoss
) -> Refined:
    """Fit the chosen features and product units to all rows.

    Args:
        solved: the geometric calibration, where it starts.
        additive: the chosen unit of order 1, as fitted in the search.
        orders: of the chosen product units.
        loss: how far-off rows count.
    """
    problem = solved.problem
    design = Design(problem, additive.design.features)
    posterior, point = additive.posterior, solved.solution.linearisation.point
    refined: Refined | None = None
    for rounds in range(1, MOST_ROUNDS + 1):
        rows = _rows(solved, point, refined.correction if refined else None, design, posterior, loss)
        before = posterior.x
        if orders and refined is None:
            design, posterior, sums = _with_products(rows, design, posterior, orders)
        else:
            sums = sum_up(design, rows.values, rows.start(design))
            posterior = maximise_evidence(sums, posterior.prior, posterior.noise)
        point = problem.nominal.index_add(0, problem.active, posterior.x[: design.active])
        refined = Refined(rows, design, posterior, sums, point, network(design, posterior), rounds)
        if rounds > 1:
            moved = (posterior.x - before) / posterior.covariance.diagonal().clamp(min=1e-300).sqrt()
            if float(moved.square().mean().sqrt()) < SETTLED:
                break
    assert refined is not None
    return refined


def refined_at(
    solved: SolvedCalibration, design: Design, posterior: Posterior, loss: AbstractLoss, rounds: int
) -> Refined:
    """All rows linearised and weighted at the most probable values of a posterior, and the posterior there.

    Args:
        solved: the geometric calibration.
        design: all unknowns.
        posterior: where to look from, with prior sizes, which stand, and noise, which is renewed.
        loss: how far-off rows count.
        rounds: rounds that it took to get there.
    """
    problem = solved.problem
    point = problem.nominal.index_add(0, problem.active, posterior.x[: design.active])
    correction = network(design, posterior)
    rows = _rows(solved, point, correction, design, posterior, loss)
    sums = sum_up(design, rows.values, rows.start(design))
    there = solve_posterior(sums, posterior.prior, posterior.noise)
    there = solve_posterior(sums, posterior.prior, renewed_noise(sums, there))
    return Refined(rows, design, there, sums, point, correction, rounds)


def network(design: Design, posterior: Posterior) -> JointCorrection:
    """The network with the weights of a posterior."""
    robot = design.problem.space.robot
    last = design.features[-1] if design.features else None
    products = last if isinstance(last, AlternatingProducts) else None
    features = design.features[:-1] if products else design.features
    made = JointCorrection(robot, features, products.orders if products else ())
    with torch.no_grad():
        for number, chosen in enumerate(features):
            made.linear[number][chosen.used] = posterior.x[design.stretch(number)].cpu()
        if products:
            factors = products.solved(posterior.x[design.stretch(len(features))])
            made.bias.copy_(factors[..., 0])
            made.weight.copy_(factors[..., 1:])
    made.requires_grad_(False)
    return made


def _rows(
    solved: SolvedCalibration,
    point: Tensor,
    correction: JointCorrection | None,
    design: Design,
    posterior: Posterior,
    loss: AbstractLoss,
) -> Rows:
    """All rows linearised at a point, weighted by their distance from what the posterior predicts."""
    problem = solved.problem
    values = sensor_values(problem, point, correction)
    here = (point - problem.nominal)[problem.active]
    weights = None if correction is None else posterior.x[len(here) :]
    rows = Rows(problem, values, here, groups_of_equal_joints(problem.q), weights)
    change = rows.start(design) - posterior.x
    used = [0.0] * len(values) if correction is None else _used(rows, design, posterior)
    return rows.weighted(weigh(values, design, change, used, loss))


def _used(rows: Rows, design: Design, posterior: Posterior) -> list[float]:
    """Values of every sensor that the unknowns use up: those that are determined, shared out by the sensors' values."""
    counts = [0.0 if sensor.certain else float(sensor.residual.numel()) for sensor in rows.values]
    return [float(posterior.determined.sum()) * count / max(sum(counts), 1.0) for count in counts]


def _with_products(
    rows: Rows, design: Design, additive: Posterior, orders: tuple[int, ...]
) -> tuple[Design, Posterior, Sums]:
    """Fit product units beside the unit of order 1; the factors on a sample of the rows, the rest on all."""
    few = rows.sample(PRODUCT_CONFIGURATIONS)
    sums = sum_up(design, few.values, few.start(design))
    additive = maximise_evidence(sums, additive.prior, additive.noise)
    fitted = ProductFit(design, few.values, few.start(design), additive, sums).fit(orders)
    sums = sum_up(fitted.design, rows.values, rows.start(fitted.design))
    return fitted.design, maximise_evidence(sums, fitted.posterior.prior, fitted.posterior.noise), sums


def with_all_factors(refined: Refined) -> Refined:
    """The same with all factors of product units free, for what is uncertain in those that were fixed.

    Their columns are the derivatives at the solution, their changes normal about 0 with the size of a weight among
    all of a factor of length 1.
    """
    units = refined.design.features[-1] if refined.design.features else None
    if not isinstance(units, AlternatingProducts):
        return refined
    weights = refined.posterior.x[refined.design.stretch(len(refined.design.features) - 1)]
    factors = units.solved(weights)
    others = [
        AlternatingProducts(refined.design.problem.space.robot, units.orders, factors, units.turn + k)
        for k in range(1, max(units.orders))
    ]
    design = replace(refined.design, features=(*refined.design.features, *others))
    extra = design.unknowns - refined.design.unknowns
    in_force = refined.rows.weights
    start = refined.posterior.x[refined.design.active :] if in_force is None else in_force
    rows = replace(refined.rows, weights=torch.cat([start, start.new_zeros(extra)]))
    sums = sum_up(design, rows.values, rows.start(design))
    prior = refined.posterior.prior
    size = len(prior.sizes)
    prior = replace(
        prior,
        base=torch.cat([prior.base, prior.base.new_ones(extra)]),
        group=torch.cat([prior.group, torch.full((extra,), size)]),
        sizes=torch.cat([prior.sizes, prior.sizes.new_tensor([factors.shape[-1] ** -0.5])]),
        standing=(size,),
    )
    posterior = solve_posterior(sums, prior, refined.posterior.noise)
    return replace(refined, rows=rows, design=design, posterior=posterior, sums=sums)


def with_frames_of(
    solved: SolvedCalibration, refined: Refined, geometry: IdentifiedGeometry
) -> IdentifiedGeometry:
    """A geometry whose frames that nothing determines are moved onto those of the geometric calibration.

    Sockets, and distances from anchors at unknown points, are met as well after any motion of the whole frame.
    Nominal joint values and predictions of both calibrations belong to one base, however; so every such frame gets the
    motion that takes the hybrid's poses nearest to the geometric ones.

    Args:
        solved: the geometric calibration.
        refined: the hybrid one.
        geometry: of the hybrid.
    """
    frames = floating_frames(solved.setup)
    if not frames:
        return geometry
    rows = solved.measurements
    first = identified_geometry(solved.setup, solved.solution.linearisation.point)
    with torch.no_grad():
        moved = replace(rows, q=rows.q + refined.correction.of_rows(rows))
    points = _points(geometry, moved), _points(first, rows)
    motions = {}
    for frame in frames:
        here = torch.tensor([name == frame for name in rows.frame])
        motions[frame] = nearest_motion(points[0][here].flatten(0, 1), points[1][here].flatten(0, 1))
    return _moved(solved, geometry, motions)


def nearest_motion(
    points: Float64[Tensor, "points 3"], onto: Float64[Tensor, "points 3"]
) -> Float64[Tensor, "4 4"]:
    """The rigid motion T that minimises `Σ |T p - p'|²` (Kabsch 1976, Acta Crystallographica A32, 922-923)."""
    middle, middle_onto = points.mean(0), onto.mean(0)
    U, _, V = torch.linalg.svd((onto - middle_onto).t() @ (points - middle))
    turned = torch.ones(3, dtype=points.dtype, device=points.device)
    turned[2] = torch.linalg.det(U @ V)
    R = U @ (turned[:, None] * V)
    return transform(R, middle_onto - R @ middle)


def _points(geometry: IdentifiedGeometry, rows: Measurements) -> Float64[Tensor, "rows 4 3"]:
    """The tool's origin and a point along each of its axes, in the frame of the row."""
    T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, rows)
    origin = T[:, None, :3, 3]
    return torch.cat([origin, origin + ARM * geometry.robot.reach * T[:, :3, :3].mT], 1)


def _moved(
    solved: SolvedCalibration, geometry: IdentifiedGeometry, motions: dict[str, Tensor]
) -> IdentifiedGeometry:
    """The geometry with everything that stands in some frames moved."""
    setup, frames = solved.setup, solved.setup.problem.space.frames
    bases = dict(geometry.bases)
    unknowns = {group: dict(owners) for group, owners in geometry.unknowns.items()}
    for frame, T in motions.items():
        base = transform_from_xyzrpy(torch.from_numpy(np.asarray(bases[frame])))
        bases[frame] = xyzrpy_from_transform(T @ base).numpy()
        for group in setup.problem.space.unknowns:
            for owner, number in zip(group.owners, setup.unknown_frames[group.name].tolist(), strict=True):
                if group.has_point and frames[number] == frame:
                    values = unknowns[group.name][owner]
                    point = (T[:3, :3] @ torch.from_numpy(np.asarray(values[:3])) + T[:3, 3]).numpy()
                    unknowns[group.name][owner] = np.concatenate([point, values[3:]])
    robot = geometry.robot.with_geometry(base=next(iter(bases.values())))
    return replace(geometry, robot=robot, bases=bases, unknowns=unknowns)

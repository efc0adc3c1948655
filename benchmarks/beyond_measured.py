"""Error of a hybrid far outside its measured joint values: fitted to series C of the UR10, evaluated on series B.

Run `OMP_NUM_THREADS=2 python benchmarks/beyond_measured.py` with the measured files in `PISIGMA_DATA`. Every line is
the root mean square of the position errors of series B [mm] for a hybrid fitted to series C, with base and tool fitted
to series B. The prior scales are estimated from series C, or from both series together, or replaced by the amplitude of
every harmonic of every joint in both series, so that only the phases are unknown. The last error is a lower bound for
every rule that estimates sizes from series C.
"""

import os
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.setup import identified_geometry
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.refinement import RefinedFit, correction_from_weights, linearise_rows
from pisigma.calibration.hybrid.regression import build_regression
from pisigma.estimation.prior import GaussianPrior
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.input_products import InputProducts
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import held_out_groups
from pisigma.robot import Robot
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses
from pisigma.validation.held_out.frames.fitted_frames import fit_frames

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data")) / "ur10"
ROUNDS = 3


def named(rows: Measurements, name: str) -> Measurements:
    """Return rows with a new frame and a new target."""
    return replace(rows, frame=(name,) * rows.rows, target=(name,) * rows.rows)


def together(first: Measurements, second: Measurements) -> Measurements:
    """Return all poses of two series."""
    q, position, rotation, temperature = (
        torch.cat([getattr(rows, name) for rows in (first, second)])
        for name in ("q", "position", "rotation", "temperature")
    )
    frame, target = first.frame + second.frame, first.target + second.target
    return Measurements(q, position, rotation, frame, target, temperature=temperature)


def fitted(
    solved: SolvedCalibration, features: tuple[AbstractFeature, ...], prior: GaussianPrior | None = None
) -> RefinedFit:
    """Return the hybrid with the given features, with estimated or given prior scales."""
    problem, group = solved.problem, held_out_groups(solved.setup.measurements)
    view, design = contributions_and_noise_of(solved.solution.linearisation), Design(problem, features)
    x = torch.zeros(design.unknowns, dtype=torch.float64)
    x[: design.active_count] = (solved.solution.linearisation.point - problem.prior_mean)[problem.active]
    noise, sizes = tuple(view.noise.tolist()), prior or design.prior(view.prior_scale.tolist())
    effective = float(design.active_count)
    for _ in range(ROUNDS):
        fit = build_regression(design, linearise_rows(design, x, effective, group))
        if prior is None:
            posterior = fit.maximise_evidence(sizes, noise)
        else:
            posterior = fit.solve(prior, noise)
            posterior = fit.solve(prior, fit.updated_noise(posterior))
        x, sizes, noise, effective = (
            posterior.x,
            posterior.prior,
            posterior.noise,
            posterior.effective_unknowns,
        )
    rows = linearise_rows(design, posterior.x, posterior.effective_unknowns, group)
    fit = build_regression(design, rows)
    there = fit.solve(posterior.prior, posterior.noise)
    there = fit.solve(posterior.prior, fit.updated_noise(there))
    point = problem.prior_mean.index_add(0, problem.active, there.x[: design.active_count])
    return RefinedFit(rows, design, there, fit, point, correction_from_weights(design, there.x), ROUNDS)


def amplitudes(both: RefinedFit, prior: GaussianPrior) -> GaussianPrior:
    """Return the prior of series C with the amplitude of every harmonic of every joint in both series."""
    design, precision = both.design, prior.precision.clone()
    # base and tool of the other series are unknowns of the fit to both series, and precede the weights
    shift = len(prior.unit_precision) - design.unknowns
    for number, feature in enumerate(design.features):
        if feature.name == "series":
            place = design.weights_of(number)
            weight = torch.zeros(feature.used.shape).to(both.posterior.x)
            weight = weight.masked_scatter(feature.used, both.posterior.x[place])
            sine, cosine = weight.chunk(2, 1)
            size = ((sine.square() + cosine.square()) / 2).repeat(1, 2)
            precision[place.start + shift : place.stop + shift] = 1 / size[feature.used]
    return replace(prior, unit_precision=precision * prior.group_scales[prior.group].square())


def error(solved: SolvedCalibration, refined: RefinedFit, rows: Measurements) -> float:
    """Return the RMS error of other rows, with base and tool fitted to them [mm]."""
    geometry = identified_geometry(solved.setup, refined.point)
    rows = named(rows, "c")
    with torch.no_grad():
        moved = replace(rows, q=rows.q + refined.correction.for_rows(rows))
    T: Tensor = predicted_poses(geometry.robot, geometry.bases, geometry.tools, moved)
    measured = MeasuredPoses.from_tensors(rows.position, rows.rotation, LEVER_SHARE * geometry.robot.reach)
    T, _ = fit_frames(T, measured, rows, ("base", "tool"))
    assert rows.position is not None
    return float((rows.position - T[:, :3, 3]).square().sum(1).mean().sqrt() * 1e3)


def main() -> None:
    """Print one line per prior."""
    robot = Robot.load("ur10")
    files = (("c", "series_c_train.csv"), ("b", "series_b.csv"))
    c, b = (named(Measurements.read_csv(DATA / file, robot), name) for name, file in files)
    learned = HybridCalibrator(robot).fit(c).learned
    assert learned is not None
    features = learned.correction.features
    if learned.correction.orders:
        features += (InputProducts(robot),)
    solved, solved_both = (GeometricCalibrator(robot).solve(rows) for rows in (c, together(c, b)))
    own, both = fitted(solved, features), fitted(solved_both, features)
    print(f"prior scales from series C                  {error(solved, own, b):.3f}", flush=True)
    known = replace(own.posterior.prior, group_scales=both.posterior.prior.group_scales)
    at_best = fitted(solved, features, known)
    print(f"prior scales from both series               {error(solved, at_best, b):.3f}", flush=True)
    at_best = fitted(solved, features, amplitudes(both, known))
    print(f"amplitude of every harmonic from both      {error(solved, at_best, b):.3f}")


if __name__ == "__main__":
    main()

"""Hybrid calibration: geometry, base, tool, unknowns of sensors and a Pi-Sigma joint correction are fitted together."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Int64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.initial_guess.initial_guess import randomly_chosen_rows
from pisigma.calibration.geometric.outliers import Outlier, outliers_of
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of, renumber
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import identified_geometry
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.arm import JointCoverage
from pisigma.calibration.hybrid.delivery import FinalCorrection, choose_final_correction
from pisigma.calibration.hybrid.design import Design, LinearisedRows, robust_weights
from pisigma.calibration.hybrid.gravity import (
    USUAL,
    gravity_by_evidence,
    gravity_sentence,
    to_first_row_frame,
)
from pisigma.calibration.hybrid.refinement import (
    RefinedFit,
    chunked_correction,
    linearise_rows,
    refine,
    with_aligned_frames,
)
from pisigma.calibration.hybrid.regression import build_regression
from pisigma.calibration.hybrid.result import HybridResult, LearnedPart
from pisigma.calibration.hybrid.search import FIRST_MODEL_SIZES, FeatureChoice, FeatureFit, FeatureSearch
from pisigma.calibration.hybrid.sensor_values import sensor_values
from pisigma.calibration.hybrid.spectrum import find_spectral_lines, log_number_of_orders
from pisigma.calibration.hybrid.uncertainty import position_uncertainty
from pisigma.estimation.regression import SMALLEST_NOISE
from pisigma.files.errors import IdentificationError, check_choice
from pisigma.joint_correction.feature import AbstractFeature, FeatureOptions
from pisigma.joint_correction.fourier_series import USUAL_HARMONICS
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.gravity_torques import Direction
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.registry import FEATURES, feature_by_name
from pisigma.measurement.conditions import varying_conditions
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints, held_out_groups
from pisigma.robot.description import Robot

SEARCHED_ROWS = 4_000
"""Largest number of rows used to select features; the final fit uses all rows."""
_GROSS = 50.0
"""Largest residual of rows used for the first model, in standard deviations of the geometric calibration."""

_NOTHING_FOUND = "The data show no errors beyond those of the geometry, so the geometric calibration is kept."

_TOO_FEW_ROWS = (
    "A joint correction would use up nearly all degrees of freedom of these few rows, so the geometric "
    "calibration is kept; measure more poses."
)

_NOTHING_HELPS = (
    "No joint correction predicts held-out rows of one sensor clearly better without predicting those of another "
    "worse, so the geometric calibration is kept."
)


@dataclass(frozen=True)
class HybridCalibrator:
    """Calibrator that fits `T(q) = base · Π A_i(q_i + Δ_i(q); dh_i + ε_i) · tool` with a Pi-Sigma network Δ.

    All unknowns have normal priors with nominal means. The prior scales of weights maximise the evidence; those of
    geometric errors are taken from the geometric calibration. Features that do not raise the evidence, or that increase
    the held-out errors, are rejected. The remaining features must predict rows that are held out of exact fits
    better than the geometric calibration does; if no feature remains, the result is the geometric calibration.

    Attributes:
        robot: the nominal robot, or its geometric calibrator if settings other than the defaults are needed.
        features: names of the features to try, see `joint_correction.registry.FEATURES`.
        harmonics: numbers of harmonics of the Fourier series, tried in this order.
        products: whether to try product units, which require two joints; without them the correction is additive.
        gravity: direction of gravity in the frame of the robot's base; None for the direction with the highest
            evidence.
    """

    robot: Robot | GeometricCalibrator
    features: tuple[str, ...] = (
        "gravity",
        "torques",
        "conditions",
        "backlash",
        "coupling",
        "lines",
        "series",
    )
    harmonics: tuple[int, ...] = (8, 24, 56, 110, 160)
    products: bool = True
    gravity: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse invalid settings."""
        for name in self.features:
            check_choice(IdentificationError, "features", name, FEATURES)
        if self.gravity is not None and not 0 < math.hypot(*self.gravity) < math.inf:
            raise IdentificationError(
                option="gravity",
                expected="a direction in the frame of the robot's base, such as (0, 0, -1)",
                value=self.gravity,
            )
        if "series" in self.features and (not self.harmonics or min(self.harmonics) < 1):
            raise IdentificationError(
                option="harmonics",
                expected="whole numbers >= 1",
                value=self.harmonics,
                remedy="omit 'series' from the features to use no series",
            )

    @property
    def geometric_calibrator(self) -> GeometricCalibrator:
        """Geometric calibrator whose prior, loss and sensor settings are used."""
        return GeometricCalibrator(self.robot) if isinstance(self.robot, Robot) else self.robot

    def fit(
        self, measurements: Measurements, progress: Callable[[str], None] = lambda what: None
    ) -> HybridResult:
        """Calibrate.

        Args:
            measurements: the measurements.
            progress: callback that is called with the current trial or step.

        Raises:
            IdentificationError: see `GeometricCalibrator.solve`.
            PoseError: the joint values do not fit the robot.
        """
        solved = self.geometric_calibrator.solve(measurements)
        group = held_out_groups(solved.setup.measurements)
        choice = self._chosen(solved, group, progress)
        if not choice.best.design.features:
            return _geometric_alone(solved, choice, _NOTHING_FOUND)
        progress("predicting held-out rows by exact fits")
        serving = choose_final_correction(solved, choice, progress)
        if serving is None:
            return _geometric_alone(solved, choice, _NOTHING_HELPS)
        choice = serving.choice
        progress("solving for all parameters")
        whole = solved.problem.rows == choice.rows.problem.rows
        refined = serving.refined if whole else refine(solved.problem, group, choice)
        if refined.regression.absorbed_share(refined.posterior) > choice.best.max_effective_share:
            return _geometric_alone(solved, choice, _TOO_FEW_ROWS)
        falling = gravity_sentence(self.geometric_calibrator.robot, choice.best.design.features)
        verdict, trials = " ".join(filter(None, (_kept_sentence(serving), falling))), choice.trials
        learned = self._learned(solved, refined)
        progress("predicting held-out rows")
        uncertainty = position_uncertainty(
            refined.rows,
            refined.design,
            refined.regression,
            refined.posterior,
            learned.geometry,
            refined.held_out_errors,
        )
        return HybridResult(solved.result(), learned, uncertainty, trials, verdict)

    def _learned(self, solved: SolvedCalibration, refined: RefinedFit) -> LearnedPart:
        """Return the correction, the geometry that was fitted together with it, and its measured ranges."""
        noise = zip(solved.problem.sensors, refined.posterior.noise, strict=True)
        return LearnedPart(
            geometry=with_aligned_frames(solved, refined),
            correction=refined.correction,
            coverage=JointCoverage.from_joints(self.geometric_calibrator.robot, solved.problem.q),
            noise={sensor.name: sigma for sensor, sigma in noise if not sensor.are_values_given},
            unknowns=refined.design.unknowns,
            effective_unknowns=refined.posterior.effective_unknowns,
            rounds=refined.rounds,
            outliers=_outliers(solved, refined),
        )

    def _chosen(
        self, solved: SolvedCalibration, group: Int64[Tensor, " rows"], progress: Callable[[str], None]
    ) -> FeatureChoice:
        """Select features on at most `SEARCHED_ROWS` rows.

        Rows that the geometric calibration does not explain need not be outliers. Therefore a first hybrid model is
        fitted to all rows except those with errors that no robot has, and rows are weighted by their residuals from it.

        If gravity seems to act in a direction other than down, both directions are tried, because torques along
        other axes may imitate products.
        """
        problem, view = solved.problem, contributions_and_noise_of(solved.solution.linearisation)
        noise, prior_scale = tuple(view.noise.tolist()), tuple(view.prior_scale.tolist())
        if problem.q.shape[0] > SEARCHED_ROWS:
            chosen = randomly_chosen_rows(problem.q.shape[0], SEARCHED_ROWS).to(problem.q.device)
            chosen = problem.with_partners(chosen)
            problem, group = problem.select(chosen), renumber(group[chosen])
        design, point = Design(problem, ()), solved.solution.linearisation.point
        values = sensor_values(problem, point)
        distances = [
            one.residual.norm(dim=1) * one.weight_root / view.loss_scales[k] for k, one in enumerate(values)
        ]
        weights = [
            ((distance < _GROSS) | one.are_values_given).to(distance)
            for distance, one in zip(distances, values, strict=True)
        ]
        rows = LinearisedRows.from_linearisation(
            design, (point - problem.prior_mean)[problem.active], values, weights, group
        )
        pairs = zip(noise, values, strict=True)
        if all(sigma <= SMALLEST_NOISE for sigma, one in pairs if not one.are_values_given):
            # The geometry explains exact data, so features would only fit the errors of the linearisation.
            search = FeatureSearch(rows, noise, prior_scale, [], progress)
            return search.try_derived_feature(search.fit_without_features, None)
        robot = self.geometric_calibrator.robot
        gravity = self.gravity or gravity_by_evidence(robot, rows, noise, prior_scale)
        directions = dict.fromkeys((gravity, self.gravity or USUAL))
        tried = [self._features(solved, problem, to_first_row_frame(robot, one)) for one in directions]
        growing, others = tried[0]
        first = Design(problem, (*others, *growing[:FIRST_MODEL_SIZES][-1:]))
        posterior = build_regression(first, rows).maximise_evidence(first.prior(prior_scale), noise)
        rows = linearise_rows(first, posterior.x, posterior.effective_unknowns, group)
        products = [InputProducts(robot)] if self.products and robot.dof > 1 else []
        choices = []
        for growing, others in tried:
            largest = [*others, *growing[-1:], *products]
            search = FeatureSearch(rows, noise, prior_scale, largest, progress)
            best = search.select_features(growing, others, products)
            orders = self._lines(rows, best)
            odds = log_number_of_orders(robot.dof) * sum(map(len, orders))
            choices.append(search.try_derived_feature(best, GearLines(robot, orders) if odds else None, odds))
        return max(choices, key=lambda choice: choice.best.posterior.log_evidence)

    def _lines(self, rows: LinearisedRows, best: FeatureFit) -> tuple[tuple[int, ...], ...]:
        """Return the orders of spectral lines in the residuals of a fit, beyond the harmonics of its series."""
        if "lines" not in self.features:
            return ()
        lowest = 1 + (max((one.size for one in best.design.features), default=0) or USUAL_HARMONICS)
        return find_spectral_lines(best.design, rows, best.posterior, lowest)

    def _features(
        self, solved: SolvedCalibration, problem: CalibrationProblem, gravity: Direction
    ) -> tuple[list[AbstractFeature], list[AbstractFeature]]:
        """Return the features to try: one feature in increasing sizes, and each of the others in one size.

        Raises:
            IdentificationError: two features have several sizes.
        """
        varying = varying_conditions(solved.setup.measurements)
        options = FeatureOptions(
            self.harmonics, gravity, int(groups_of_equal_joints(problem.q).max()) + 1, varying
        )
        growing: list[AbstractFeature] = []
        others: list[AbstractFeature] = []
        for name in self.features:
            tried = feature_by_name(name).candidates(
                self.geometric_calibrator.robot, options, solved.problem.state
            )
            if not any(feature.size for feature in tried):
                others += tried
            elif growing:
                raise IdentificationError(
                    f"'{growing[0].name}' and '{name}' both have several sizes, but only one such feature can be tried",
                    option="features",
                    value=(growing[0].name, name),
                    remedy="omit one of them",
                )
            else:
                growing += tried
        return growing, others


def _outliers(solved: SolvedCalibration, refined: RefinedFit) -> tuple[Outlier, ...]:
    """Return the rows with less than half of the full weight in the hybrid calibration, worst first."""
    problem, setup, found = solved.problem, solved.setup, []
    values = sensor_values(problem, refined.point, chunked_correction(refined.correction))
    weights = robust_weights(problem, values, refined.posterior.effective_unknowns)
    for number, (one, weight) in enumerate(zip(values, weights, strict=True)):
        length, sensor = one.residual.norm(dim=1), problem.sensors[number]
        deviations = length * one.weight_root / refined.posterior.noise[number]
        found += outliers_of(setup, solved.measurements, sensor, one.row, length, deviations, weight)
    return tuple(sorted(found, key=lambda outlier: -outlier.residual_in_sigmas))


def _kept_sentence(serving: FinalCorrection) -> str:
    """Return a sentence about the chosen correction and the resulting prediction of held-out rows."""
    best = serving.choice.best
    return (
        f"A joint correction was kept ({best.name}): held-out rows are predicted with "
        f"{serving.held_out_ratio:.2f} times the error of the geometric calibration."
    )


def _geometric_alone(solved: SolvedCalibration, choice: FeatureChoice, verdict: str) -> HybridResult:
    """Return the geometric calibration, with the uncertainty of its positions."""
    geometry = identified_geometry(solved.setup, solved.solution.linearisation.point)
    first = choice.fit_without_features
    fit = build_regression(first.design, choice.rows)
    uncertainty = position_uncertainty(
        choice.rows, first.design, fit, first.posterior, geometry, first.held_out_errors
    )
    return HybridResult(solved.result(), None, uncertainty, choice.trials, verdict)

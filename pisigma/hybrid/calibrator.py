"""The hybrid calibrator: geometry, base, tool, sensor unknowns and a Pi-Sigma joint correction together."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pisigma.errors import IdentificationError, nearest_choice
from pisigma.hybrid.arm import JointCoverage
from pisigma.hybrid.design import Rows
from pisigma.hybrid.evidence import effective_share
from pisigma.hybrid.mini_batches import MANY_ROWS, MiniBatches, batch_checkpoints, refine_in_batches
from pisigma.hybrid.refinement import Refined, refine, with_all_factors, with_frames_of
from pisigma.hybrid.result import HybridResult, LearnedPart
from pisigma.hybrid.search import LARGEST_EFFECTIVE_SHARE, Additive, Search, best_products
from pisigma.hybrid.sensor_values import sensor_values
from pisigma.hybrid.uncertainty import position_uncertainty
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.initial_guess.initial_guess import chosen_rows
from pisigma.identification.problem.noise import view_of
from pisigma.identification.problem.problem import CalibrationProblem
from pisigma.identification.problem.setup import identified_geometry
from pisigma.identification.result import SolvedCalibration
from pisigma.joint_correction.feature import AbstractFeature, FeatureOptions
from pisigma.joint_correction.registry import FEATURES, feature_named
from pisigma.measurement.conditions import stated_conditions
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.robot.description import Robot

SEARCHED_ROWS = 4_000
"""Features and product units are chosen on so many rows at most; everything is fitted to all in the end."""


@dataclass(frozen=True)
class HybridCalibrator:
    """Fits `T(q) = base · Π A_i(q_i + Δ_i(q); dh_i + ε_i) · tool` to measurements, Δ a Pi-Sigma network.

    All unknowns are normal with means at nominal and prior sizes that maximise the evidence. Whatever does not
    raise the evidence, or predicts left-out rows no better, is left out; if nothing is left the result is that of
    the geometric calibration.

    Attributes:
        robot: the nominal robot; or its geometric calibrator, where that needs other settings than its defaults.
        features: of the unit of order 1 that are tried, by the names of `joint_correction.registry.FEATURES`.
        harmonics: of the Fourier series, tried in this order.
        orders: numbers of factors of product units, tried in this order; none for an additive correction.
        gravity: direction in which things fall, in the frame of the robot's first row.
        mini_batches: whether the unknowns of the chosen model are trained on mini-batches instead of with the
            normal equations of all rows: True or False; how; or "auto", which does so from `MANY_ROWS` rows on.
    """

    robot: Robot | GeometricCalibrator
    features: tuple[str, ...] = ("gravity", "conditions", "backlash", "series")
    harmonics: tuple[int, ...] = (8, 24, 56, 110)
    orders: tuple[tuple[int, ...], ...] = ((2,), (2, 2), (2, 2, 2, 2))
    gravity: tuple[float, float, float] = (0.0, 0.0, -1.0)
    mini_batches: MiniBatches | bool | Literal["auto"] = "auto"

    def __post_init__(self) -> None:
        """Refuse choices that do not exist."""
        for name in self.features:
            if name not in FEATURES:
                raise IdentificationError(
                    f"features: '{name}' is no choice; {nearest_choice(name, FEATURES)}"
                )
        if "series" in self.features and (not self.harmonics or min(self.harmonics) < 1):
            raise IdentificationError(
                f"harmonics={self.harmonics}: whole numbers of at least 1 were wanted for the series; leave "
                "'series' out of features for none."
            )
        if any(min(orders, default=0) < 2 for orders in self.orders):
            raise IdentificationError(
                f"orders={self.orders}: a product unit has two factors or more; give tuples such as (2,)."
            )

    @property
    def geometric(self) -> GeometricCalibrator:
        """The geometric calibrator, whose sensors, priors and loss are used."""
        return GeometricCalibrator(self.robot) if isinstance(self.robot, Robot) else self.robot

    def fit(
        self,
        measurements: Measurements,
        progress: Callable[[str], None] = lambda what: None,
        checkpoints: Path | None = None,
        resume: bool = False,
    ) -> HybridResult:
        """Calibrate.

        Args:
            measurements: what was measured.
            progress: called with what is being tried.
            checkpoints: folder for checkpoints of a training on mini-batches; None keeps none.
            resume: go on from the checkpoint there.

        Returns:
            The result. After a training on mini-batches its verdict says how near to the optimum that came.

        Raises:
            IdentificationError: see `GeometricCalibrator.solve`.
            PoseError: the joint values do not fit the robot.
            TrainingError: the training diverged, or there is no checkpoint of this calibration to resume.
            OutputError: checkpoints cannot be written.
        """
        batches = self._batches(measurements.rows)
        kept = None
        if batches is not None and checkpoints is not None:
            kept = batch_checkpoints(checkpoints, f"{self}|{measurements.content_hash()}", resume)
        solved = self.geometric.solve(measurements)
        search, additive, orders = self._chosen(solved, progress)
        if not additive.design.features and not orders:
            verdict = "Nothing beyond the geometry was found in the data: the geometric calibration stands."
            return _geometric_alone(solved, search, verdict)
        progress("solving for everything")
        loss, trained = self.geometric.loss, ""
        if batches is None:
            refined = refine(solved, additive, orders, loss)
        else:
            few = searched_rows(solved.problem)
            refined, trained = refine_in_batches(
                solved, few, additive, orders, loss, batches=batches, progress=progress, checkpoints=kept
            )
        if effective_share(refined.sums, refined.posterior) > LARGEST_EFFECTIVE_SHARE:
            verdict = (
                "A joint correction would take up nearly all that the few rows say, so the geometric calibration "
                "stands; measure more poses."
            )
            return _geometric_alone(solved, search, verdict)
        learned = self._learned(solved, refined)
        verdict = _kept_sentence(search, additive, orders, trained)
        whole = with_all_factors(refined)
        uncertainty = position_uncertainty(
            whole.rows, whole.design, whole.posterior, whole.sums, learned.geometry
        )
        return HybridResult(solved.result(), learned, uncertainty, tuple(search.trials), verdict)

    def _learned(self, solved: SolvedCalibration, refined: Refined) -> LearnedPart:
        """The correction with the geometry that belongs to it, and where it was measured."""
        noise = zip(solved.result().noise, refined.posterior.noise, strict=True)
        return LearnedPart(
            geometry=with_frames_of(solved, refined, identified_geometry(solved.setup, refined.point)),
            correction=refined.correction,
            coverage=JointCoverage.of(self.geometric.robot, solved.problem.q),
            noise={geometric.sensor: sigma for geometric, sigma in noise},
            unknowns=refined.design.unknowns,
            effective=refined.effective,
            rounds=refined.rounds,
        )

    def _batches(self, rows: int) -> MiniBatches | None:
        """How so many rows are trained on mini-batches; None where they are not."""
        if isinstance(self.mini_batches, MiniBatches):
            return self.mini_batches
        wanted = rows >= MANY_ROWS if self.mini_batches == "auto" else self.mini_batches
        return MiniBatches() if wanted else None

    def _chosen(
        self, solved: SolvedCalibration, progress: Callable[[str], None]
    ) -> tuple[Search, Additive, tuple[int, ...]]:
        """Features and orders of product units, on at most `SEARCHED_ROWS` rows."""
        problem = searched_rows(solved.problem)
        here = solved.solution.linearisation
        view = view_of(here)
        values = sensor_values(problem, here.point)
        weights = []
        for number, sensor in enumerate(values):
            distance = sensor.residual.norm(dim=1) * sensor.root / view.scale(number)
            loss = problem.loss_of(problem.sensors[number])
            weights.append(loss.weight(distance, sensor.components))
        point = (here.point - problem.nominal)[problem.active]
        rows = Rows(problem, values, point, groups_of_equal_joints(problem.q)).weighted(weights)
        growing, others = self._features(solved, rows)
        search = Search(rows, view.noise, view.prior_scale, [*others, *growing[-1:]], progress)
        additive = search.best_additive(growing, others)
        additive, orders = best_products(search, additive, self.orders)
        return search, additive, orders

    def _features(
        self, solved: SolvedCalibration, rows: Rows
    ) -> tuple[list[AbstractFeature], list[AbstractFeature]]:
        """What is tried: ever larger features of one name, and one feature each of the other names.

        Raises:
            IdentificationError: two features would be tried in several sizes.
        """
        varying = stated_conditions(solved.setup.measurements)
        options = FeatureOptions(self.harmonics, self.gravity, rows.configurations, varying)
        growing: list[AbstractFeature] = []
        others: list[AbstractFeature] = []
        for name in self.features:
            tried = feature_named(name).candidates(self.geometric.robot, options, solved.problem.state)
            if not any(feature.size for feature in tried):
                others += tried
            elif growing:
                raise IdentificationError(
                    f"features: '{growing[0].name}' and '{name}' both come in several sizes, but one such feature can "
                    "be tried at a time; leave one out."
                )
            else:
                growing += tried
        return growing, others


def _kept_sentence(search: Search, additive: Additive, orders: tuple[int, ...], trained: str) -> str:
    """What was kept, and how much better left-out rows are predicted with it."""
    names = [feature.label for feature in additive.design.features]
    names += [f"product units of orders {orders}"] if orders else []
    share = [trial.left_out for trial in search.trials if trial.kept][-1]
    return (
        f"A joint correction was kept ({' + '.join(names)}): left-out rows are predicted with {share:.2f} "
        f"times the error of the geometric calibration. {trained}".rstrip()
    )


def _geometric_alone(solved: SolvedCalibration, search: Search, verdict: str) -> HybridResult:
    """The geometric calibration, with the uncertainty of its positions."""
    geometry = identified_geometry(solved.setup, solved.solution.linearisation.point)
    first = search.geometry
    uncertainty = position_uncertainty(search.rows, first.design, first.posterior, first.sums, geometry)
    return HybridResult(solved.result(), None, uncertainty, tuple(search.trials), verdict)


def searched_rows(problem: CalibrationProblem) -> CalibrationProblem:
    """The problem with the rows that features and product units are chosen on."""
    if problem.q.shape[0] <= SEARCHED_ROWS:
        return problem
    return problem.select(chosen_rows(problem.q.shape[0], SEARCHED_ROWS).to(problem.q.device))

"""Recipes: models to train, data, settings of the training, and published figures for comparison."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.estimation.loss import HampelLoss, SquaredLoss
from pisigma.files.yaml_file import Section, Seed
from pisigma.network.sections import FitSection, NetworkSection
from pisigma.robot.description import Robot
from pisigma.simulation.measure import SimulatedPoses, SimulatedTracker
from pisigma.simulation.true_robot import ErrorSource
from pisigma.validation.held_out.training_summary import BeforeAfter


class AbstractRecipe(Section):
    """Keys of every recipe.

    Attributes:
        name: name of the recipe and, by default, of the model.
        description: purpose of the recipe, for the card of the model.
        not_validated: limits of the validation, for the card of the model.
        robot: catalogue name or robot file of the nominal robot.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    description: str
    not_validated: str
    robot: str


class SimulatedData(Section):
    """Measurements of a simulated true robot.

    Attributes:
        kind: "simulated".
        errors: all error sources of the true robot.
        training: measurements for training.
        held_out: held-out measurements for validation.
    """

    kind: Literal["simulated"]
    errors: tuple[ErrorSource, ...]
    training: SimulatedPoses
    held_out: SimulatedTracker


class MeasuredData(Section):
    """Measurements of a real robot, given with `--data`.

    Attributes:
        kind: "measured".
        folds: number of folds of the cross-validation. Rows with equal joint values are in the same fold.
        seed: random seed of the folds.
    """

    kind: Literal["measured"]
    folds: Annotated[int, Field(ge=2, le=1000)] = 5
    seed: Seed = 0


class SingularRows(Section):
    """Treatment of training rows near a singularity, where joint differences become arbitrarily large.

    Attributes:
        rule: "keep" all rows, or "leave_out" rows at which the smallest singular value of the
            Jacobian is less than `below`.
        below: limit on the smallest singular value of the Jacobian, whose translations are divided by the
            characteristic length.
    """

    rule: Literal["keep", "leave_out"] = "leave_out"
    below: NonNegativeFloat = 0.02


class InverseRecipe(AbstractRecipe):
    """An inverse calibration: networks on nominal joint values.

    Attributes:
        kind: "inverse_calibration", the default.
        name: name of the recipe and, by default, of the model.
        description: purpose of the recipe, for the card of the model.
        not_validated: limits of the validation, for the card of the model.
        robot: catalogue name or robot file of the nominal robot.
        data: source of the measurements.
        network: groups of joints to correct, with a network each.
        fit: how the networks are trained.
        singular_rows: treatment of training rows near a singularity.
        paper: published figures by joint, for comparison.
    """

    kind: Literal["inverse_calibration"] = "inverse_calibration"
    data: Annotated[SimulatedData | MeasuredData, Field(discriminator="kind")]
    network: Annotated[tuple[NetworkSection, ...], Field(min_length=1)]
    fit: Annotated[FitSection, Field(discriminator="method")]
    singular_rows: SingularRows = SingularRows()
    paper: dict[str, BeforeAfter] = Field(default_factory=dict)


class PriorSection(Section):
    """Prior standard deviations of the errors of geometric parameters, such as from the maker's tolerances.

    Attributes:
        length_mm: prior standard deviation of a and d [mm].
        angle_mrad: prior standard deviation of theta, alpha and beta [mrad].
    """

    length_mm: PositiveFloat = 1.0
    angle_mrad: PositiveFloat = 1.0

    def prior(self) -> Prior:
        """Return the prior in SI units."""
        length, angle = self.length_mm / 1e3, self.angle_mrad / 1e3
        return Prior(theta=angle, d=length, a=length, alpha=angle, beta=angle)


class CalibrationSection(Section):
    """Settings of `GeometricCalibrator`.

    Attributes:
        free: parameters to identify, "identifiable", "joint_offsets" or names.
        base: "free" to identify the base, or "fixed" to use that of the robot.
        tool: "free" to identify the tool, or "fixed" to use that of the robot.
        elimination: how redundant parameters are eliminated, "exact", "pairwise" (as in the paper) or "none".
        prior: prior of the geometric errors, null for none.
        robust: whether outliers are down-weighted.
        maximum_iterations: maximum number of iterations.
    """

    free: Literal["identifiable", "joint_offsets"] | tuple[str, ...] = "identifiable"
    base: Literal["free", "fixed"] = "free"
    tool: Literal["free", "fixed"] = "free"
    elimination: Literal["exact", "pairwise", "none"] = "exact"
    prior: PriorSection | None = PriorSection()
    robust: bool = True
    maximum_iterations: Annotated[int, Field(ge=1, le=100_000)] = 100

    def calibrator(self, robot: Robot) -> GeometricCalibrator:
        """Return the calibrator for a robot."""
        return GeometricCalibrator(
            robot,
            free=self.free,
            base=self.base,
            tool=self.tool,
            elimination=self.elimination,
            prior=self.prior.prior() if self.prior else None,
            loss=HampelLoss() if self.robust else SquaredLoss(),
            maximum_iterations=self.maximum_iterations,
        )


class GeometricRecipe(AbstractRecipe):
    """A geometric calibration of a simulated robot.

    Attributes:
        kind: "geometric_calibration".
        name: name of the recipe and, by default, of the model.
        description: purpose of the recipe, for the card of the model.
        not_validated: limits of the validation, for the card of the model.
        robot: catalogue name or robot file of the nominal robot.
        errors: all error sources of the true robot.
        measurements: measurements for the calibration.
        held_out: held-out measurements for validation.
        calibration: settings of the calibrator.
        paper: published figures by name, for comparison.
    """

    kind: Literal["geometric_calibration"]
    errors: tuple[ErrorSource, ...]
    measurements: SimulatedPoses
    held_out: SimulatedTracker
    calibration: CalibrationSection = CalibrationSection()
    paper: dict[str, float | int | str | list[str] | list[list[str]]] = Field(default_factory=dict)


class HybridSection(Section):
    """Candidates for `HybridCalibrator`, which omits candidates that do not improve the fit.

    Attributes:
        features: features of the unit of order 1 to try.
        harmonics: harmonics of the Fourier series to try, in this order.
        products: whether to try product units.
        gravity: direction of gravity in the robot's base frame; null to find it by the evidence of the data.
    """

    features: tuple[str, ...] = HybridCalibrator.features
    harmonics: tuple[Annotated[int, Field(ge=1, le=1000)], ...] = HybridCalibrator.harmonics
    products: bool = HybridCalibrator.products
    gravity: tuple[float, float, float] | None = HybridCalibrator.gravity

    def calibrator(self, geometric: GeometricCalibrator) -> HybridCalibrator:
        """Return the hybrid calibrator that extends a geometric calibrator.

        Raises:
            IdentificationError: a setting is not a valid choice.
        """
        return HybridCalibrator(geometric, **dict(self))


class LearningCurveSection(Section):
    """Numbers of training rows of a learning curve.

    Attributes:
        rows: numbers of training rows to try, in addition to all of them.
        seed: random seed of the choice of rows.
    """

    rows: Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
    seed: Seed = 0


class HybridRecipe(AbstractRecipe):
    """A hybrid calibration, compared with the nominal robot and with the geometric calibration.

    Attributes:
        kind: "hybrid_calibration".
        name: name of the recipe and, by default, of the model.
        description: purpose of the recipe, for the card of the model.
        not_validated: limits of the validation, for the card of the model.
        robot: catalogue name or robot file of the nominal robot.
        data: source of the measurements. Measured rows are validated in folds, simulated rows on held-out rows.
        repeats: number of repeats of a simulation, each with all seeds increased by one. The model is from the first
            repeat.
        calibration: settings of the geometric calibrator.
        hybrid: settings of the hybrid calibrator.
        learning_curve: learning curve to compute, null for none.
    """

    kind: Literal["hybrid_calibration"]
    data: Annotated[SimulatedData | MeasuredData, Field(discriminator="kind")]
    repeats: Annotated[int, Field(ge=1, le=100)] = 1
    calibration: CalibrationSection = CalibrationSection()
    hybrid: HybridSection = HybridSection()
    learning_curve: LearningCurveSection | None = None

    def calibrator(self, robot: Robot) -> HybridCalibrator:
        """Return the calibrator for a robot.

        Raises:
            IdentificationError: a setting of the section `hybrid` is not a valid choice.
        """
        return self.hybrid.calibrator(self.calibration.calibrator(robot))


Recipe = InverseRecipe | GeometricRecipe | HybridRecipe

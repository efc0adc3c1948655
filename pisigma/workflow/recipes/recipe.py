"""Recipes: what to train, on what, how, and which published figures to hold it against."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.estimation.loss import HampelLoss, SquaredLoss
from pisigma.files.yaml_file import Section, Seed
from pisigma.network.sections import FitSection, NetworkSection
from pisigma.robot.description import Robot
from pisigma.simulation.measure import SimulatedMeasurements, SimulatedPoses
from pisigma.simulation.true_robot import ErrorSource
from pisigma.validation.held_out.training_summary import BeforeAfter


class AbstractRecipe(Section):
    """What every recipe states.

    Attributes:
        name: of the recipe and, by default, of the model.
        description: what it shows, for the model's card.
        not_validated: what a reader must not take from it, for the card.
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
        errors: what is wrong with the true robot, completely.
        training: what is measured for training.
        held_out: what the fit is judged on and never sees.
    """

    kind: Literal["simulated"]
    errors: tuple[ErrorSource, ...]
    training: SimulatedPoses
    held_out: SimulatedMeasurements


class MeasuredData(Section):
    """Measurements of a real robot, given with `--data`.

    Attributes:
        kind: "measured".
        folds: number of folds of the cross-validation; rows of equal joints stay together.
        seed: of the folds.
    """

    kind: Literal["measured"]
    folds: Annotated[int, Field(ge=2, le=1000)] = 5
    seed: Seed = 0


class SingularRows(Section):
    """What happens to training rows near a singularity, where joint differences explode.

    Attributes:
        rule: "keep", or "leave_out" where the measure is below the bound.
        below: smallest singular value of the joint Jacobian, translations over the characteristic length.
    """

    rule: Literal["keep", "leave_out"] = "leave_out"
    below: NonNegativeFloat = 0.02


class InverseRecipe(AbstractRecipe):
    """An inverse calibration: networks on nominal joint values.

    Attributes:
        kind: "inverse_calibration", which need not be stated.
        name: of the recipe and, by default, of the model.
        description: what it shows, for the model's card.
        not_validated: what a reader must not take from it, for the card.
        robot: catalogue name or robot file of the nominal robot.
        data: where measurements come from.
        network: the groups of joints to correct.
        fit: how the networks are trained.
        singular_rows: rule for rows near a singularity.
        paper: published figures by joint, to stand beside ours.
    """

    kind: Literal["inverse_calibration"] = "inverse_calibration"
    data: Annotated[SimulatedData | MeasuredData, Field(discriminator="kind")]
    network: Annotated[tuple[NetworkSection, ...], Field(min_length=1)]
    fit: Annotated[FitSection, Field(discriminator="method")]
    singular_rows: SingularRows = SingularRows()
    paper: dict[str, BeforeAfter] = Field(default_factory=dict)


class PriorSection(Section):
    """Standard deviations of the parameters' errors: what the maker's tolerances say.

    Attributes:
        length_mm: of a and d [mm].
        angle_mrad: of theta, alpha and beta [mrad].
    """

    length_mm: PositiveFloat = 1.0
    angle_mrad: PositiveFloat = 1.0

    def prior(self) -> Prior:
        """The same in SI units."""
        length, angle = self.length_mm / 1e3, self.angle_mrad / 1e3
        return Prior(theta=angle, d=length, a=length, alpha=angle, beta=angle)


class CalibrationSection(Section):
    """Settings of `GeometricCalibrator`.

    Attributes:
        free: "identifiable", "joint_offsets" or names of parameters.
        base: "free", or "fixed" to the robot's own.
        tool: the same for the tool.
        elimination: how redundant parameters are left out: "exact", "pairwise" (the paper's) or "none".
        prior: None for none.
        robust: whether rows that are far off count less.
        maximum_iterations: steps tried at most.
    """

    free: Literal["identifiable", "joint_offsets"] | tuple[str, ...] = "identifiable"
    base: Literal["free", "fixed"] = "free"
    tool: Literal["free", "fixed"] = "free"
    elimination: Literal["exact", "pairwise", "none"] = "exact"
    prior: PriorSection | None = PriorSection()
    robust: bool = True
    maximum_iterations: Annotated[int, Field(ge=1, le=100_000)] = 100

    def calibrator(self, robot: Robot) -> GeometricCalibrator:
        """The calibrator for a robot."""
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
        name: of the recipe and, by default, of the model.
        description: what it shows, for the model's card.
        not_validated: what a reader must not take from it, for the card.
        robot: catalogue name or robot file of the nominal robot.
        errors: what is wrong with the true robot, completely.
        measurements: what is measured for the calibration.
        held_out: what the calibration is judged on and never sees.
        calibration: settings of the calibrator.
        paper: published figures to stand beside ours, by name.
    """

    kind: Literal["geometric_calibration"]
    errors: tuple[ErrorSource, ...]
    measurements: SimulatedPoses
    held_out: SimulatedMeasurements
    calibration: CalibrationSection = CalibrationSection()
    paper: dict[str, float | int | str | list[str] | list[list[str]]] = Field(default_factory=dict)


class HybridSection(Section):
    """What `HybridCalibrator` may choose from; whatever does not help is left out.

    Attributes:
        features: of the unit of order 1 that are tried.
        harmonics: of the Fourier series, tried in this order.
        products: whether product units are tried.
        gravity: direction in which things fall, in the frame of the robot's base; without it, by evidence.
    """

    features: tuple[str, ...] = HybridCalibrator.features
    harmonics: tuple[Annotated[int, Field(ge=1, le=1000)], ...] = HybridCalibrator.harmonics
    products: bool = HybridCalibrator.products
    gravity: tuple[float, float, float] | None = HybridCalibrator.gravity

    def calibrator(self, geometric: GeometricCalibrator) -> HybridCalibrator:
        """The calibrator, on top of a geometric one.

        Raises:
            IdentificationError: a choice does not exist.
        """
        return HybridCalibrator(geometric, **dict(self))


class LearningCurveSection(Section):
    """Which numbers of training rows are tried.

    Attributes:
        rows: the numbers; all training rows come on top.
        seed: decides which rows are drawn.
    """

    rows: Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
    seed: Seed = 0


class HybridRecipe(AbstractRecipe):
    """A hybrid calibration, judged beside the nominal robot and the geometric calibration.

    Attributes:
        kind: "hybrid_calibration".
        name: of the recipe and, by default, of the model.
        description: what it shows, for the model's card.
        not_validated: what a reader must not take from it, for the card.
        robot: catalogue name or robot file of the nominal robot.
        data: where measurements come from; measured ones are judged in folds, simulated ones on held-out rows.
        repeats: of a simulation, with all its seeds one higher each time; the model is of the first.
        calibration: settings of the geometric calibrator.
        hybrid: settings of the hybrid calibrator.
        learning_curve: numbers of training rows to try; None for none.
    """

    kind: Literal["hybrid_calibration"]
    data: Annotated[SimulatedData | MeasuredData, Field(discriminator="kind")]
    repeats: Annotated[int, Field(ge=1, le=100)] = 1
    calibration: CalibrationSection = CalibrationSection()
    hybrid: HybridSection = HybridSection()
    learning_curve: LearningCurveSection | None = None

    def calibrator(self, robot: Robot) -> HybridCalibrator:
        """The calibrator for a robot.

        Raises:
            IdentificationError: a choice of the section `hybrid` does not exist.
        """
        return self.hybrid.calibrator(self.calibration.calibrator(robot))


Recipe = InverseRecipe | GeometricRecipe | HybridRecipe

"""Recipes of the geometric calibrator on simulated robots."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.problem.loss import HampelLoss, SquaredLoss
from pisigma.identification.problem.parameters import Prior
from pisigma.identification.result import CalibrationResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.true_robot import ErrorSource
from pisigma.yaml_file import Section


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
    maximum_iterations: PositiveInt = 100

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


class GeometricRecipe(Section):
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
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    description: str
    not_validated: str
    robot: str
    errors: tuple[ErrorSource, ...]
    measurements: SimulatedMeasurements
    held_out: SimulatedMeasurements
    calibration: CalibrationSection = CalibrationSection()
    paper: dict[str, float | int | str | list[str] | list[list[str]]] = Field(default_factory=dict)

    def calibrate(self, measurements: Measurements) -> CalibrationResult:
        """Calibrate the nominal robot on the rows.

        Raises:
            IdentificationError: the rows do not determine what is asked for.
        """
        return self.calibration.calibrator(Robot.load(self.robot)).fit(measurements)

"""Recipes of the geometric calibrator on simulated robots."""

import math
import re
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from pisigma.errors import IdentificationError
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


def calibration_section(free: str, prior_mm: float, prior_mrad: float, robust: bool) -> CalibrationSection:
    """Settings as the command line gives them.

    Args:
        free: "identifiable", "joint_offsets", or names of parameters with commas between them.
        prior_mm: standard deviation of length errors [mm]; 0 for no prior.
        prior_mrad: the same of angle errors [mrad].
        robust: see `CalibrationSection`.

    Raises:
        IdentificationError: one of the two standard deviations is 0 and the other is not, or one is below 0
            or no finite number.
    """
    given = (prior_mm, prior_mrad)
    if not all(map(math.isfinite, given)) or min(given) < 0 or (prior_mm == 0) != (prior_mrad == 0):
        raise IdentificationError(
            f"the prior's standard deviations were wanted above 0, or both 0 for none, got {prior_mm:g} mm and "
            f"{prior_mrad:g} mrad."
        )
    prior = PriorSection(length_mm=prior_mm, angle_mrad=prior_mrad) if prior_mm else None
    named = free in ("identifiable", "joint_offsets")
    return CalibrationSection(
        free=free if named else tuple(name.strip() for name in free.split(",")),
        prior=prior,
        robust=robust,
    )


def known_socket_distances(stated: str | None, sockets: Sequence[str]) -> dict[tuple[str, str], float]:
    """Known distances between sockets as the command line gives them.

    Args:
        stated: "A,B,MM"; a * in both names stands for the same text, so that "*/0,*/1,50" means 50 mm between a/0 and
            a/1, b/0 and b/1 and so on. None for none.
        sockets: the names in the data.

    Returns:
        By the names of two sockets their distance [m].

    Raises:
        IdentificationError: it is not of this form, or no two sockets have such names.
    """
    if stated is None:
        return {}
    parts = [part.strip() for part in stated.split(",")]
    try:
        first, second, distance = parts[0], parts[1], float(parts[2])
    except (IndexError, ValueError):
        distance = 0.0
    if len(parts) != 3 or not 0 < distance < float("inf"):
        raise IdentificationError(
            f"a known socket distance as A,B,MM was wanted, such as */0,*/1,50, got '{stated}'."
        )
    pattern = re.compile(re.escape(first).replace(r"\*", "(.*)", 1))
    found = {}
    for name in dict.fromkeys(sockets):
        match = pattern.fullmatch(name)
        other = second.replace("*", match[1], 1) if match and "*" in first else second
        if match and other in sockets:
            found[name, other] = distance / 1e3
    if not found:
        raise IdentificationError(
            f"no two sockets of the data are called '{first}' and '{second}'; there are "
            f"{', '.join(dict.fromkeys(sockets)) or 'none'}."
        )
    return found

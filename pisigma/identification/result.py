"""What a calibration comes to: the robot, its parameters with their errors, and what the data cannot determine."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pisigma.identification.identifiability.observability import Observability
from pisigma.identification.identifiability.pairwise import PairwiseRedundancy
from pisigma.identification.identifiability.redundancy import Redundancy
from pisigma.identification.prediction import predicted_poses
from pisigma.identification.problem.least_squares import SolutionStatus
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.sensors.registry import measured_errors


@dataclass(frozen=True)
class ParameterEstimate:
    """One row of the parameter table, in SI units.

    Attributes:
        name: such as "theta_1".
        unit: "m" or "rad".
        nominal: as drawn.
        estimated: as identified.
        change: estimated - nominal.
        standard_error: of the estimate; NaN where it was not estimated.
        remark: "identified", what it is only identified together with, or why it was not estimated.
        label: the remark in a few words, for tables.
    """

    name: str
    unit: str
    nominal: float
    estimated: float
    change: float
    standard_error: float
    remark: str
    label: str

    @property
    def free(self) -> bool:
        """Whether it was estimated."""
        return not np.isnan(self.standard_error)


@dataclass(frozen=True)
class SensorNoise:
    """Noise of one kind of sensor, as the residuals show it.

    Attributes:
        sensor: "position", "rotation", "touch", "socket", "distance", "pair", "socket distance", or the name of a
            registered sensor.
        sigma: standard deviation of one value [m or rad]; where the rows state their own, the factor on it.
        unit: "m" or "rad", or "stated" for a factor on what the rows state.
        values: number of measured values.
        used: how many of them the parameters used up.
        rms: root mean square of the residuals' lengths, all rows [m or rad].
        quantity: "m" where the sensor measures lengths, "rad" where it measures angles.
        components: values a row.
    """

    sensor: str
    sigma: float
    unit: str
    values: int
    used: float
    rms: float
    quantity: Literal["m", "rad"]
    components: int


@dataclass(frozen=True)
class Outlier:
    """A row that counted for less than half.

    Attributes:
        row: its number in the measurements, from 0.
        place: file and line, or source and row, as complaints name the row.
        sensor: which value of the row.
        residual: length of the residual [m or rad].
        deviations: the same in standard deviations of one value.
        unit: "m" or "rad".
    """

    row: int
    place: str
    sensor: str
    residual: float
    deviations: float
    unit: Literal["m", "rad"]


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A geometric calibration.

    Attributes:
        robot: the calibrated robot, with the base of the first frame and the tool of the first target.
        bases: per frame x, y, z [m], roll, pitch, yaw [rad].
        tools: the same per target.
        parameters: all parameters, free or not.
        covariance: of all parameters in their order (SI), zero where they were not free.
        residuals: per sensor, measured - predicted of every row [m or rad], NaN where it measured nothing.
        outliers: rows that counted for less than half, the worst first.
        noise: per sensor.
        redundancy: rank, chosen parameters and dependencies at the start.
        pairwise: redundancy the paper's way, by Pearson correlation.
        extended: parameters that were added because at the solution the data do determine them.
        weak_directions: directions that the data hardly determine, in words; there the nominal value stands.
        observability: indices O1 to O5 of the free parameters at the solution.
        iterations: steps tried.
        cost: sum of squared residuals over variances, with loss and prior.
        status: why the search ended.
        rms_path: RMS of the first sensor's residuals' lengths at every point passed [m], the start first.
        warnings: what to measure next, in sentences.
        unknowns: by group and owner, what the sensors found out about themselves, in the owner's frame: of a
            "socket" x, y, z [m], of an "anchor" x, y, z and what its sensor shows at no distance [m].
    """

    robot: Robot
    bases: dict[str, Float64[np.ndarray, " 6"]]
    tools: dict[str, Float64[np.ndarray, " 6"]]
    parameters: tuple[ParameterEstimate, ...]
    covariance: Float64[np.ndarray, "parameters parameters"]
    residuals: dict[str, Float64[np.ndarray, "rows components"]]
    outliers: tuple[Outlier, ...]
    noise: tuple[SensorNoise, ...]
    redundancy: Redundancy
    pairwise: PairwiseRedundancy
    extended: tuple[str, ...]
    weak_directions: tuple[str, ...]
    observability: Observability
    iterations: int
    cost: float
    status: SolutionStatus
    rms_path: tuple[float, ...]
    warnings: tuple[str, ...]
    unknowns: dict[str, dict[str, Float64[np.ndarray, " columns"]]] = field(default_factory=dict)

    @property
    def rank(self) -> int:
        """How many independent combinations of the parameters the data determine, at the nominal geometry.

        Counted after the sensors' own unknowns, which may take any value.
        """
        return self.redundancy.rank

    @property
    def condition_number(self) -> float:
        """Of the Jacobian of the free parameters, in mm and mrad."""
        return self.observability.condition_number

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return tuple(parameter.name for parameter in self.parameters if parameter.free)

    def parameter(self, name: str) -> ParameterEstimate:
        """The row of the parameter table with that name.

        Raises:
            KeyError: there is none.
        """
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(name)

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Measured - predicted of any measurements in calibrated frames with calibrated targets, such as held-out ones.

        Returns:
            By sensor [m or rad], NaN where a row has no value; see `pisigma.sensors.registry.measured_errors`. A
            socket that was not calibrated is where its own rows meet on average.

        Raises:
            IdentificationError: a row has a frame, a target or an anchor that was not calibrated.
        """
        T = predicted_poses(self.robot, self.bases, self.tools, measurements)
        return measured_errors(T, measurements, self.unknowns)

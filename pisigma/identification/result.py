"""What a calibration comes to: the robot, its parameters with their errors, and what the data do not tell."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pisigma.identification.identifiability.observability import Observability
from pisigma.identification.identifiability.pairwise import PairwiseRedundancy, find_pairwise_redundancy
from pisigma.identification.identifiability.redundancy import Redundancy, find_redundancy
from pisigma.identification.prediction import prediction_errors
from pisigma.identification.problem.information import Information
from pisigma.identification.problem.least_squares import SolutionStatus
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot


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
        sensor: "position", "rotation", "touch", "socket", "distance", "pair" or "socket distance".
        sigma: standard deviation of one value [m or rad]; where the rows give their own, the factor on it.
        unit: "m" or "rad", or "given" for a factor.
        values: number of measured values.
        used: how many of them the parameters used up.
        rms: root mean square of the residuals' lengths, all rows [m or rad].
    """

    sensor: str
    sigma: float
    unit: str
    values: int
    used: float
    rms: float


@dataclass(frozen=True)
class Outlier:
    """A row that counted for less than half.

    Attributes:
        row: its number in the measurements, from 0.
        place: file and line, or source and row.
        sensor: which value of the row.
        residual: length of the residual [m or rad].
        deviations: the same in standard deviations of one value.
    """

    row: int
    place: str
    sensor: str
    residual: float
    deviations: float


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A geometric calibration.

    Attributes:
        robot: the calibrated robot, with the base of the first frame and the tool of the first target.
        bases: per frame x, y, z [m], roll, pitch, yaw [rad].
        tools: the same per target.
        parameters: all parameters, free or not.
        covariance: of all parameters in their order (SI), zero where they were not free.
        residuals: per sensor, measured - predicted of every row [m or rad], NaN where it saw nothing.
        outliers: rows that counted for less than half, the worst first.
        noise: per sensor.
        redundancy: rank, chosen parameters and dependencies at the start.
        information: what `redundancy` was found from.
        sizes: nominal values behind `information`.
        extended: parameters that were added because at the solution the data do tell them.
        weak_directions: directions that the data hardly see, in words; there the nominal value stands.
        observability: indices O1 to O5 of the free parameters at the solution.
        iterations: steps tried.
        cost: sum of squared residuals over variances, with loss and prior.
        status: why the search ended.
        rms_path: RMS of the first sensor's residuals' lengths at every point passed [m], the start first.
        warnings: what to measure next, in sentences.
        sockets: per socket, its place in its frame [m].
        anchors: per anchor, its place in its frame [m].
        zeros: per anchor, what its sensor shows at no distance [m].
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
    information: Information
    sizes: Float64[np.ndarray, " candidates"]
    extended: tuple[str, ...]
    weak_directions: tuple[str, ...]
    observability: Observability
    iterations: int
    cost: float
    status: SolutionStatus
    rms_path: tuple[float, ...]
    warnings: tuple[str, ...]
    sockets: dict[str, Float64[np.ndarray, " 3"]] = field(default_factory=dict)
    anchors: dict[str, Float64[np.ndarray, " 3"]] = field(default_factory=dict)
    zeros: dict[str, float] = field(default_factory=dict)

    @property
    def rank(self) -> int:
        """How many independent combinations of the parameters the data see, at the nominal geometry.

        Counted after the places of sockets and anchors and the zeros, which may take any value.
        """
        return self.redundancy.rank

    @cached_property
    def arm_rank(self) -> int:
        """The same of the arm's parameters alone, after bases and tools too."""
        groups = [parameter.group for parameter in self.information.parameters]
        nuisance = [k for k, group in enumerate(groups) if group in ("base", "tool")]
        rest = self.information.after(nuisance)
        sizes = np.zeros(len(rest.parameters))
        return find_redundancy(rest, sizes, self.redundancy.tolerance).rank

    @property
    def condition_number(self) -> float:
        """Of the Jacobian of the free parameters, in mm and mrad."""
        return self.observability.condition_number

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return tuple(parameter.name for parameter in self.parameters if parameter.free)

    @cached_property
    def pairwise(self) -> PairwiseRedundancy:
        """Redundancy the paper's way, by Pearson correlation."""
        return find_pairwise_redundancy(self.information, self.sizes)

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
        """Measured - predicted of any measurements with known frames and targets, such as held-out ones.

        Returns:
            What was measured of "position", "touch", "socket", "distance" and "pair" [m] and "rotation" [rad],
            one value a row or three; NaN where a row has none. A socket that was not calibrated is where its
            own rows meet on average.

        Raises:
            IdentificationError: a row has a frame, a target or an anchor that is not known.
        """
        return prediction_errors(
            self.robot, self.bases, self.tools, measurements, self.sockets, self.anchors, self.zeros
        )

"""Settings for calibrating a fleet."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pisigma.files.errors import FleetError, check_choice

EngineName = Literal["processes", "ray"]


@dataclass(frozen=True)
class FleetSettings:
    """Settings for calibrating a fleet.

    Attributes:
        engine: where to run: processes (on this machine) or ray.
        jobs: number of processes that work in parallel. None: one per core.
        address: address of a Ray cluster. None: Ray on this machine.
        prior: model folder written by `pisigma fleet prior`, from which the calibrations start. Cells that state
            settings of the calibration are then refused.

    Raises:
        FleetError: a setting is not a valid choice, or `jobs` is less than 1.
    """

    engine: EngineName = "processes"
    jobs: int | None = None
    address: str | None = None
    prior: Path | None = None

    def __post_init__(self) -> None:
        """Check choices and ranges."""
        check_choice(FleetError, "engine", self.engine, get_args(EngineName))
        if self.jobs is not None and self.jobs < 1:
            raise FleetError(expected="an integer >= 1", value=self.jobs, option="jobs")
        if self.address is not None and self.engine != "ray":
            raise FleetError(
                f"only the engine ray has an address, got '{self.address}'",
                value=self.address,
                option="address",
                remedy="choose the engine ray, or omit the address",
            )

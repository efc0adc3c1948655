"""Settings of the calibration of a fleet."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

from pisigma.files.errors import FleetError, check_choice
from pisigma.files.setting import HIDDEN
from pisigma.workflow.settings.calibration import CalibrationSettings

Task = Literal["calibrate", "recalibrate", "monitor"]
EngineName = Literal["processes", "ray"]


@dataclass(frozen=True)
class FleetSettings:
    """Settings of the calibration of a fleet.

    Attributes:
        task: what to do with each robot's sessions: calibrate, recalibrate or monitor. Calibrate treats every session
            by itself, recalibrate updates the model of the session before, and monitor compares later sessions with the
            first one's model. A robot that states a model starts from it.
        validate: cross-validate every calibration and draw the figures of its card.
        calibration: settings of every robot's calibration, which the robot's own options override. Its folds are used
            only with `validate`.
        engine: where to run: processes (on this machine) or ray.
        jobs: number of processes that work in parallel. None: one per core.
        address: address of a Ray cluster. None: Ray on this machine.
        prior: model folder of `pisigma fleet prior` to start the calibrations from. It replaces the settings of the
            calibration, and every row is cross-validated.

    Raises:
        FleetError: a setting is not a valid choice, or there are no jobs.
    """

    task: Task = "calibrate"
    validate: bool = False
    calibration: Annotated[CalibrationSettings, HIDDEN] = field(default_factory=CalibrationSettings)
    engine: EngineName = "processes"
    jobs: int | None = None
    address: str | None = None
    prior: Path | None = None

    def __post_init__(self) -> None:
        """Check choices and ranges."""
        check_choice(FleetError, "task", self.task, get_args(Task))
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

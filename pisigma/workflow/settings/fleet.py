"""What is done with every robot of a fleet, and where."""

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
    """What is done with every robot, and where.

    Attributes:
        task: calibrate: every session by itself; recalibrate: the first is calibrated, and every later one brings the
            model of the one before up to date; monitor: the first is calibrated, and the later ones are compared with
            its model. A robot with a model of its own begins with that.
        validate: cross-validate every calibration and draw the figures of its card.
        calibration: of every robot, but for what its own options say; its folds count only with `validate`.
        engine: processes: of this machine; or ray.
        jobs: processes that work side by side. None: one per core.
        address: address of a Ray cluster. None: Ray on this machine.
        prior: model folder of `pisigma fleet prior` that calibrations begin with, which have no use for the settings of
            a calibration and whose rows are left out in turn anyway.

    Raises:
        FleetError: something is no choice, or there are no jobs.
    """

    task: Task = "calibrate"
    validate: bool = False
    calibration: Annotated[CalibrationSettings, HIDDEN] = field(default_factory=CalibrationSettings)
    engine: EngineName = "processes"
    jobs: int | None = None
    address: str | None = None
    prior: Path | None = None

    def __post_init__(self) -> None:
        """Refuse what is no choice."""
        check_choice(FleetError, "task", self.task, get_args(Task))
        check_choice(FleetError, "engine", self.engine, get_args(EngineName))
        if self.jobs is not None and self.jobs < 1:
            raise FleetError(f"jobs: 1 or more were wanted, got {self.jobs}.")
        if self.address is not None and self.engine != "ray":
            raise FleetError(
                f"address {self.address}: only the engine ray has one; choose it, or leave it out."
            )

"""The measuring instrument of a cell and its calibration certificate, as `cell.yaml` states them."""

from typing import Annotated

from pydantic import Field, field_validator

from pisigma.files.yaml_file import Section
from pisigma.measurement.dates import EXPECTED_DATE, is_date
from pisigma.robot.row import BoundedFloat


class Instrument(Section):
    """The measuring instrument and its calibration.

    Attributes:
        name: manufacturer and type.
        serial: serial number.
        certificate: number of the calibration certificate.
        calibrated: date of the calibration (ISO 8601).
        expanded_uncertainty_mm: expanded uncertainty U of a measured coordinate at the distance of the robot [mm].
        coverage_factor: coverage factor k of U, as the certificate states it.
    """

    name: str | None = None
    serial: str | None = None
    certificate: str | None = None
    calibrated: str | None = None
    expanded_uncertainty_mm: Annotated[BoundedFloat, Field(gt=0)] | None = None
    coverage_factor: Annotated[BoundedFloat, Field(ge=1, le=10)] | None = None

    @field_validator("calibrated")
    @classmethod
    def _is_date(cls, stated: str | None) -> str | None:
        if stated is not None and not is_date(stated):
            raise ValueError(f"expected {EXPECTED_DATE}, got {stated}")
        return stated

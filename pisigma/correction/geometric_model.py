"""A geometric calibration as a model that corrected inverse kinematics can be made from."""

import platform
from importlib.metadata import version

from pisigma.correction.calibrated_model import CalibratedModel, Provenance
from pisigma.identification.result import CalibrationResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot

MAXIMUM_STARTS = 512


def model_of_calibration(
    name: str,
    nominal: Robot,
    result: CalibrationResult,
    measurements: Measurements,
    recipe: tuple[str, str] = ("", ""),
) -> CalibratedModel:
    """Make the model of a geometric calibration.

    Its poses are those of the first target in the first frame of the measurements. Nominal joint values are those of
    the nominal arm on the base and with the tool that were identified.

    Args:
        name: of the model.
        nominal: the robot as drawn.
        result: its calibration.
        measurements: the rows it was calibrated with.
        recipe: name and SHA-256 of the recipe, where there was one.
    """
    return CalibratedModel(
        name=name,
        kind="geometric_calibration",
        robot=nominal.with_geometry(base=result.robot.base, tool=result.robot.tool),
        network=None,
        domain=None,
        branches=(),
        starts=measurements.q[:MAXIMUM_STARTS].clone(),
        calibrated=result.robot,
        bases=dict(result.bases),
        tools=dict(result.tools),
        provenance=Provenance(
            recipe=recipe[0],
            recipe_sha256=recipe[1],
            data_source=measurements.source.rsplit("/", 1)[-1],
            data_sha256=measurements.content_hash(),
            rows=measurements.rows,
            rows_left_out=len(measurements.left_out),
            versions={name: version(name) for name in ("pisigma", "torch")}
            | {"python": platform.python_version()},
        ),
    )

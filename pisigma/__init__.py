"""pisigma: robot calibration and corrected inverse kinematics.

Names are loaded on first use (PEP 562), so that `import pisigma` costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pisigma.errors import PisigmaError as PisigmaError
    from pisigma.hybrid.calibrator import HybridCalibrator as HybridCalibrator
    from pisigma.hybrid.result import HybridResult as HybridResult
    from pisigma.identification.calibrator import GeometricCalibrator as GeometricCalibrator
    from pisigma.identification.result import CalibrationResult as CalibrationResult
    from pisigma.inverse.corrected_ik import CorrectedIK as CorrectedIK
    from pisigma.inverse.corrected_ik import load as load
    from pisigma.inverse.solution import Solution as Solution
    from pisigma.joint_correction.registry import register_feature as register_feature
    from pisigma.kernels.array_kinematics import forward_kinematics as forward_kinematics
    from pisigma.kernels.array_kinematics import joint_jacobian as joint_jacobian
    from pisigma.kinematics.status import Status as Status
    from pisigma.measurement.dataset import Measurements as Measurements
    from pisigma.network.pi_sigma import PiSigma as PiSigma
    from pisigma.robot.description import Robot as Robot
    from pisigma.sensors.registry import register_sensor as register_sensor
    from pisigma.workflow.calibrate import Calibration as Calibration
    from pisigma.workflow.calibrate import CalibrationSettings as CalibrationSettings
    from pisigma.workflow.calibrate import calibrate as calibrate
    from pisigma.workflow.distill import Distillation as Distillation
    from pisigma.workflow.distill import DistillationSettings as DistillationSettings
    from pisigma.workflow.distill import distill as distill
    from pisigma.workflow.evaluate import EvaluationSettings as EvaluationSettings
    from pisigma.workflow.evaluate import Limits as Limits
    from pisigma.workflow.evaluate import evaluate as evaluate
    from pisigma.workflow.report import report as report
    from pisigma.workflow.train import train as train
    from pisigma.workflow.train_networks import TrainSettings as TrainSettings
    from pisigma.workflow.verify import VerificationSettings as VerificationSettings
    from pisigma.workflow.verify import verify as verify

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "pisigma.workflow.calibrate",
    "CalibrationResult": "pisigma.identification.result",
    "CalibrationSettings": "pisigma.workflow.calibrate",
    "CorrectedIK": "pisigma.inverse.corrected_ik",
    "Distillation": "pisigma.workflow.distill",
    "DistillationSettings": "pisigma.workflow.distill",
    "EvaluationSettings": "pisigma.workflow.evaluate",
    "GeometricCalibrator": "pisigma.identification.calibrator",
    "HybridCalibrator": "pisigma.hybrid.calibrator",
    "HybridResult": "pisigma.hybrid.result",
    "Limits": "pisigma.workflow.evaluate",
    "Measurements": "pisigma.sensors.registry",  # not its own home, so that files have the columns of all sensors
    "PiSigma": "pisigma.network.pi_sigma",
    "PisigmaError": "pisigma.errors",
    "Robot": "pisigma.robot.description",
    "Solution": "pisigma.inverse.solution",
    "Status": "pisigma.kinematics.status",
    "TrainSettings": "pisigma.workflow.train_networks",
    "VerificationSettings": "pisigma.workflow.verify",
    "calibrate": "pisigma.workflow.calibrate",
    "distill": "pisigma.workflow.distill",
    "evaluate": "pisigma.workflow.evaluate",
    "forward_kinematics": "pisigma.kernels.array_kinematics",
    "joint_jacobian": "pisigma.kernels.array_kinematics",
    "load": "pisigma.inverse.corrected_ik",
    "register_feature": "pisigma.joint_correction.registry",
    "register_sensor": "pisigma.sensors.registry",
    "report": "pisigma.workflow.report",
    "train": "pisigma.workflow.train",
    "verify": "pisigma.workflow.verify",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module 'pisigma' has no attribute '{name}'")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names without importing them."""
    return sorted([*globals(), *_HOMES])

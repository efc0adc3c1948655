"""pisigma: robot calibration and corrected inverse kinematics.

Names are loaded on first use (PEP 562), so that `import pisigma` is fast.
"""

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

_NAMES = {
    "files.errors": "PisigmaError",
    "calibration.hybrid.calibrator": "HybridCalibrator",
    "calibration.hybrid.result": "HybridResult",
    "calibration.geometric.calibrator": "GeometricCalibrator",
    "calibration.geometric.result": "CalibrationResult",
    "model.inverse.corrected_ik": "CorrectedIK",
    "model.inverse.solution": "Solution",
    "deployment.export.urdf": "to_pinocchio",
    "joint_correction.registry": "register_feature",
    "deployment.lerobot.correction": "LeRobotCorrection",
    "deployment.lerobot.dataset": "correct_lerobot_dataset",
    "lifetime.comparison.paired_arms": "compare_paired_arms estimate_zero_changes",
    "robot.kernels.array_kinematics": "forward_kinematics joint_jacobian",
    "robot.kinematics.status": "Status",
    "network.pi_sigma": "PiSigma",
    "planning.surroundings.surroundings": "Surroundings",
    "planning.plan_settings": "PlanSettings",
    "robot.description": "Robot",
    "measurement.sensors.registry": "Measurements register_sensor",
    "workflow.cell.cell": "Cell",
    "workflow.arms.calibrate_arms": "Arm ArmsCalibration calibrate_arms",
    "workflow.arms.find_moved_arms": "ArmsMovement find_moved_arms",
    "workflow.calibrate": "Calibration calibrate",
    "workflow.frames.calibrate_frame": "FrameCalibration calibrate_frame",
    "workflow.compare": "ComparedModels compare",
    "workflow.distill": "Distillation distill",
    "workflow.evaluate": "evaluate",
    "workflow.fleet.run": "FleetRun run_fleet",
    "workflow.fleet.prior": "estimate_fleet_prior",
    "workflow.import_rows": "import_rows",
    "workflow.load": "load",
    "workflow.monitor": "MonitoringResult monitor",
    "workflow.plan": "Plan plan",
    "workflow.recalibrate": "Recalibration recalibrate",
    "workflow.report": "report",
    "workflow.train": "train",
    "workflow.settings.calibration": "CalibrationSettings",
    "workflow.settings.evaluation": "EvaluationSettings Limits",
    "workflow.settings.verification": "VerificationSettings",
    "workflow.settings.recalibration": "RecalibrationSettings",
    "workflow.settings.monitoring": "MonitorSettings",
    "workflow.settings.comparison": "ComparisonSettings",
    "workflow.settings.fleet": "FleetSettings",
    "workflow.settings.training": "TrainSettings",
    "workflow.settings.distillation": "DistillationSettings",
    "workflow.settings.importing": "ImportSettings",
    "workflow.verify": "verify",
}
"""Public names by the modules that define them; `__init__.pyi` declares them to type checkers. `Measurements` comes
from the registry of sensors, so that files may have the columns of all sensors."""

_HOMES = {name: f"pisigma.{module}" for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'pisigma' has no attribute '{name}'")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names without importing them."""
    return sorted([*globals(), *_HOMES])

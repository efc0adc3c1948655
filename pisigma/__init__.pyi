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
from pisigma.workflow.import_rows import ImportSettings as ImportSettings
from pisigma.workflow.import_rows import import_rows as import_rows
from pisigma.workflow.report import report as report
from pisigma.workflow.train import train as train
from pisigma.workflow.train_networks import TrainSettings as TrainSettings
from pisigma.workflow.verify import VerificationSettings as VerificationSettings
from pisigma.workflow.verify import verify as verify

__version__: str
__all__: list[str]

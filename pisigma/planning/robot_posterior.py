"""Normal distribution of all unknowns of a robot, before or after poses are measured."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.prior_scales import PriorGroup, prior_group_of
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.gravity import USUAL, to_first_row_frame
from pisigma.calibration.hybrid.noise import JOINT
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.calibration.hybrid.sensor_values import joint_value_parameters
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot, multiply_updated_root
from pisigma.files.errors import IdentificationError, ImplausibleError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import Direction, GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.planning.board_sight import BoardSight
from pisigma.planning.plan_settings import SensorKind
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.robot_class import RobotClass
from pisigma.robot.se3 import skew

_WIDE_PRIOR = (*(1.0,) * 6, *(0.1,) * 3, *(1.0,) * 3)
"""Standard deviations of base and tool before any measurement [m, rad, m, rad], which are too wide to have an
effect."""

_POSES_PER_CHUNK = 512
"""Number of poses whose derivatives are computed together (a few MB)."""


@dataclass(frozen=True)
class Instrument:
    """The measuring instrument and its noise, which includes the repeatability of the robot.

    Attributes:
        kind: "position" of a target, its "pose", its "distance" from an anchor, or a "camera" that sees a board.
        sigma: standard deviation of a coordinate or a distance [m]. The default lies between the residuals of a laser
            tracker's coordinates after hybrid calibrations of the measured UR5 (0.028 mm) and UR10 (0.043 mm).
        sigma_rotation: standard deviation of an angle about an axis [rad]; the default is the value of the UR10's
            target.
        anchor: origin of distances in the measuring frame [m].
        sight: camera and board, one of which is the measuring frame and the other the target; None for other kinds.
    """

    kind: SensorKind = "position"
    sigma: float = 3.5e-5
    sigma_rotation: float = 1.1e-4
    anchor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sight: BoardSight | None = None


@dataclass(frozen=True, eq=False)
class RobotPosterior:
    """Normal distribution of geometry, base, tool and the weights of a joint correction, and the instrument.

    The predicted poses are those of the first target in the first measuring frame.

    Attributes:
        uncertainty: covariance `R R^T` of all unknowns, and the geometry at which derivatives are computed.
        correction: mean joint correction; None if it is 0.
        instrument: the measuring instrument.
    """

    uncertainty: PositionUncertainty
    correction: JointCorrection | None
    instrument: Instrument = Instrument()

    @staticmethod
    def from_robot(
        robot: Robot,
        instrument: Instrument = Instrument(),
        *,
        hybrid: bool = True,
        gravity: Direction = USUAL,
    ) -> "RobotPosterior":
        """Return the prior of a robot that was never measured, with the nominal geometry as mean.

        Geometric errors and weights have the standard deviations of the robot's class, see `RobotClass`.

        Args:
            robot: nominal robot; its tool should be near the target.
            instrument: the measuring instrument.
            hybrid: whether the joint correction is unknown, as well as the geometry.
            gravity: direction of gravity in the robot's base frame.
        """
        space = ParameterSpace(robot)
        usual, sizes = RobotClass.from_robot(robot), [_geometric_sizes(space)]
        features: tuple[AbstractFeature, ...] = ()
        if hybrid:
            torques = GravityTorques(robot, to_first_row_frame(robot, gravity))
            series = FourierSeries(robot, usual.harmonics)
            sizes += [
                _weight_sizes(torques, (usual.gravity_sigma,)),
                _weight_sizes(series, usual.series_sigmas),
            ]
            features = torques, series
        if instrument.kind == "distance":  # distances do not change with rotations about the anchor
            sizes[0][[*space.indices_of("base")][3:]] = 0.0
        root = CovarianceRoot(torch.diag(torch.cat(sizes)))
        geometry = IdentifiedGeometry(robot, {"": robot.base}, {"": robot.tool}, {})
        return RobotPosterior(PositionUncertainty(space, geometry, features, root, 1.0), None, instrument)

    @staticmethod
    def from_model(model: CalibratedModel, instrument: Instrument = Instrument()) -> "RobotPosterior":
        """Return the posterior that a calibrated model stores.

        Raises:
            IdentificationError: the model stores no posterior.
        """
        if model.uncertainty is None:
            raise IdentificationError(
                f"model '{model.name}' has no stored posterior, which planning requires",
                value=model.name,
                remedy="plan for its robot, or calibrate it with this version",
            )
        return RobotPosterior(
            model.uncertainty, None if model.hybrid is None else model.hybrid.correction, instrument
        )

    @staticmethod
    def from_result(result: HybridResult, instrument: Instrument) -> "RobotPosterior":
        """Return the posterior of a hybrid calibration."""
        return RobotPosterior(
            result.uncertainty, None if result.learned is None else result.learned.correction, instrument
        )

    def calibrated_with(self, rows: Measurements) -> "RobotPosterior":
        """Return the posterior given measured rows, from a hybrid calibration with these rows.

        If there are too few rows for a calibration, only the covariance is updated, from the joint values.

        Raises:
            PoseError: the joint values do not fit the robot.
            ImplausibleError: no geometric errors of the robot explain the rows.
        """
        try:
            return RobotPosterior.from_result(
                HybridCalibrator(self.uncertainty.space.robot).fit(rows), self.instrument
            )
        except ImplausibleError:
            raise
        except IdentificationError:  # there are too few rows for a calibration
            return self.after_measuring(rows.q)

    def after_measuring(self, q: Float64[Tensor, "poses dof"]) -> "RobotPosterior":
        """Return the posterior after measuring poses, which is independent of the values: `C' = R (1 + B^T B)^-1 R^T`.

        Args:
            q: commanded joint values [rad or m].
        """
        root = multiply_updated_root(self.uncertainty.dense_root, self.sensitivities(q).flatten(0, 1))
        return replace(self, uncertainty=replace(self.uncertainty, covariance_root=CovarianceRoot(root)))

    def corrected_joints(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch dof"]:
        """Return joint values with the mean joint correction [rad or m]."""
        if self.correction is None:
            return q
        with torch.no_grad():
            moved: Tensor = q + self.correction(q)
        return moved

    def pose_derivatives(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses 6 unknowns"]:
        """Compute derivatives of the target's position [m] and rotation [rad] with respect to all unknowns."""
        return self.uncertainty.pose_derivatives(JointState(q), self.corrected_joints(q))

    def tool_derivatives(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses 3 directions"]:
        """Compute the derivative D of the target's position with respect to standard normal numbers.

        The covariance of the position is `D D^T`. The position is in the measuring frame or, for distances, which do
        not determine where the robot is, in the robot's base frame. For a camera, a rigid motion of all poses together
        is ignored, because the pose of the board's frame is known only through the arm.
        """
        columns = self.pose_derivatives(q)[:, :3]
        if self.instrument.sight is not None:
            # Project out the rigid motions of all points: shifts, and rotations about their mean for good conditioning.
            points = forward_kinematics(self.uncertainty.geometry.robot, self.corrected_joints(q))[:, :3, 3]
            shifts = torch.eye(3).to(points).expand(len(points), 3, 3)
            rigid = torch.linalg.qr(torch.cat([shifts, skew(points - points.mean(0))], -1).flatten(0, 1)).Q
            flat = columns.flatten(0, 1)
            columns = (flat - rigid @ (rigid.t() @ flat)).view_as(columns)
        if self.instrument.kind == "distance":
            columns[..., [*self.uncertainty.space.indices_of("base")]] = 0.0
        return self.uncertainty.covariance_root.left_multiply(columns)

    def sensitivities(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses values directions"]:
        """Compute the derivative B of measured values divided by their noise; their covariance is `B B^T + 1`."""
        return torch.cat([self._measured(some) for some in torch.split(q, _POSES_PER_CHUNK)])

    def _measured(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses values directions"]:
        columns, instrument = self.pose_derivatives(q), self.instrument
        if instrument.kind == "distance":
            geometry = self.uncertainty.geometry
            away = forward_kinematics(geometry.robot, self.corrected_joints(q))[:, :3, 3] - q.new_tensor(
                instrument.anchor
            )
            # A wire measures only the motion along its direction.
            columns = (away / away.norm(dim=1, keepdim=True))[:, None] @ columns[:, :3] / instrument.sigma
        elif instrument.kind == "position":
            columns = columns[:, :3] / instrument.sigma
        elif instrument.sight is not None:
            T = forward_kinematics(self.uncertainty.geometry.robot, self.corrected_joints(q))
            columns = instrument.sight.whitening_matrix(T) @ columns
        else:
            noise = q.new_tensor([instrument.sigma] * 3 + [instrument.sigma_rotation] * 3)
            columns = columns / noise[:, None]
        return self.uncertainty.covariance_root.left_multiply(self._with_joint_noise(columns))

    def _with_joint_noise(
        self, columns: Float64[Tensor, "poses values unknowns"]
    ) -> Float64[Tensor, "poses values unknowns"]:
        """Divide values with unit noise by the noise that includes the repeatability of the joints, `1 + J J^T`."""
        of_class = RobotClass.from_robot(self.uncertainty.space.robot).joint_repeatability
        deviation = self.uncertainty.noise.value.get(JOINT, of_class)
        if not deviation:
            return columns
        J = deviation * columns[..., joint_value_parameters(self.uncertainty.space)]
        noise = torch.eye(columns.shape[1], dtype=columns.dtype) + J @ J.mT
        whitened: Tensor = torch.linalg.solve_triangular(torch.linalg.cholesky(noise), columns, upper=False)
        return whitened

    def with_unknown_base_and_tool(
        self, base: Float64[np.ndarray, " 6"], tool: Float64[np.ndarray, " 6"]
    ) -> "RobotPosterior":
        """Return the distribution for the same arm in another measuring frame with another target, both unknown.

        Args:
            base: approximate pose of the robot's base in that frame, as x, y, z, roll, pitch, yaw [m, rad].
            tool: approximate pose of the target in the frame of the last joint, in the same form.
        """
        before = self.uncertainty
        robot = before.geometry.robot.with_geometry(base=base, tool=tool)
        geometry = IdentifiedGeometry(robot, {"": base}, {"": tool}, {})
        space = ParameterSpace(before.space.robot)
        arm, weights = (
            before.dense_root[: space.arm_parameter_count],
            before.dense_root[len(before.space.parameters) :],
        )
        wide = torch.diag(torch.tensor(_WIDE_PRIOR, dtype=torch.float64))
        blank = arm.new_zeros(len(wide), arm.shape[1])
        zeros = [rows.new_zeros(len(rows), len(wide)) for rows in (arm, weights)]
        # The new base and tool are independent of the arm: their wide prior is added as a diagonal block.
        rows = [torch.cat(pair, 1) for pair in ((arm, zeros[0]), (blank, wide), (weights, zeros[1]))]
        root = CovarianceRoot(torch.cat(rows))
        return replace(
            self, uncertainty=replace(before, space=space, geometry=geometry, covariance_root=root)
        )

    def sigma(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, " poses"]:
        """Compute the standard deviation of the predicted position [m], `sqrt(σx² + σy² + σz²)`."""
        return self.tool_derivatives(q).square().sum((1, 2)).sqrt()


def _geometric_sizes(space: ParameterSpace) -> Float64[Tensor, " parameters"]:
    """Return the prior standard deviations of all parameters of a robot that was never measured [m or rad]."""
    of_class, sizes = RobotClass.from_robot(space.robot), []
    arm = zip(space.parameters[: space.arm_parameter_count], space.robot.dh.ravel().tolist(), strict=True)
    for parameter, value in arm:
        group = PriorGroup(prior_group_of(parameter.group, abs(value) > of_class.prior_sizes.length))
        sizes.append(of_class.prior_sizes.size_of(group))
    return torch.tensor([*sizes, *_WIDE_PRIOR], dtype=torch.float64)


def _weight_sizes(feature: AbstractFeature, of_groups: tuple[float, ...]) -> Float64[Tensor, " weights"]:
    """Return the prior standard deviations of the used weights of a feature [rad, or m for prismatic joints]."""
    sizes = torch.tensor(of_groups, dtype=torch.float64)[feature.group]
    unit = torch.where(torch.tensor(feature.robot.revolute), 1.0, feature.robot.reach)
    return (sizes * unit[:, None])[feature.used]

"""What is known of a robot before the next pose is measured: the normal distribution of all its unknowns."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.prior_sizes import PriorGroup, prior_group_of
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.gravity import USUAL, in_first_row
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot, after_values
from pisigma.files.errors import IdentificationError, ImplausibleError, MeasurementError
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
from pisigma.robot.se3 import rotation_vector, skew

WIDE = (*(1.0,) * 6, *(0.1,) * 3, *(1.0,) * 3)
"""[m, rad, m, rad] Where base and tool may be before anything is measured: so wide that it does not matter."""

CHUNK = 512
"""Poses whose derivatives are taken together: some MB."""


@dataclass(frozen=True)
class Instrument:
    """What measures, and how well; repeatability of the robot counts as noise of the instrument.

    Attributes:
        kind: "position" of a target, its "pose", its "distance" from an anchor, or a "camera" that sees a board.
        sigma: standard deviation of a coordinate or a distance [m]. The default lies between what hybrid calibrations
            of the measured UR5 and UR10 leave of a laser tracker's coordinates, 0.028 and 0.043 mm.
        sigma_rotation: standard deviation of an angle about an axis [rad], of the UR10's target.
        anchor: where distances are from, in the measuring frame [m].
        sight: camera and board; one is the measuring frame, the other one the target. None of other kinds.
    """

    kind: SensorKind = "position"
    sigma: float = 3.5e-5
    sigma_rotation: float = 1.1e-4
    anchor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sight: BoardSight | None = None


@dataclass(frozen=True, eq=False)
class Knowledge:
    """The normal distribution of geometry, base, tool and the weights of a joint correction, and what measures them.

    Poses are those of the first target in the first frame.

    Attributes:
        uncertainty: the covariance `R R^T` of all unknowns, and the geometry where derivatives are taken.
        correction: the most probable joint correction; None where it is 0.
        instrument: what measures.
    """

    uncertainty: PositionUncertainty
    correction: JointCorrection | None
    instrument: Instrument = Instrument()

    @staticmethod
    def of_robot(
        robot: Robot,
        instrument: Instrument = Instrument(),
        *,
        hybrid: bool = True,
        gravity: Direction = USUAL,
    ) -> "Knowledge":
        """Give what is known of a robot that was never measured: errors of usual sizes around the drawing.

        Geometric errors and weights have the standard deviations of the robot's class, see `RobotClass`.

        Args:
            robot: as drawn; its tool should be about where the target is.
            instrument: what will measure it.
            hybrid: whether joint corrections are unknowns too, or the geometry alone.
            gravity: direction in which things fall, in the frame of the robot's base.
        """
        space = ParameterSpace(robot)
        usual, sizes = RobotClass.of(robot), [_geometric_sizes(space)]
        features: tuple[AbstractFeature, ...] = ()
        if hybrid:
            torques = GravityTorques(robot, in_first_row(robot, gravity))
            series = FourierSeries(robot, usual.harmonics)
            sizes += [_weight_sizes(torques, (usual.gravity,)), _weight_sizes(series, usual.bands)]
            features = torques, series
        if instrument.kind == "distance":  # no distance changes when all is turned about the anchor
            sizes[0][[*space.of("base")][3:]] = 0.0
        root = CovarianceRoot(torch.diag(torch.cat(sizes)))
        geometry = IdentifiedGeometry(robot, {"": robot.base}, {"": robot.tool}, {})
        return Knowledge(PositionUncertainty(space, geometry, features, root, 1.0), None, instrument)

    @staticmethod
    def of_model(model: CalibratedModel, instrument: Instrument = Instrument()) -> "Knowledge":
        """Give what a calibrated model knows: its posterior.

        Raises:
            IdentificationError: the model holds no uncertainty.
        """
        if model.uncertainty is None:
            raise IdentificationError(
                f"model '{model.name}' holds no uncertainty, so it does not say what to measure next; plan for its "
                "robot, or calibrate it with this version."
            )
        return Knowledge(
            model.uncertainty, None if model.hybrid is None else model.hybrid.correction, instrument
        )

    @staticmethod
    def of_result(result: HybridResult, instrument: Instrument) -> "Knowledge":
        """Give what a calibration knows: its posterior."""
        return Knowledge(
            result.uncertainty, None if result.learned is None else result.learned.correction, instrument
        )

    def after(self, rows: Measurements) -> "Knowledge":
        """Return what is known once rows are measured: the posterior of a hybrid calibration of them.

        While they are too few for one, the covariance after measuring them, whatever their values.

        Raises:
            PoseError: the joint values do not fit the robot.
            ImplausibleError: no calibration error explains the rows.
        """
        try:
            return Knowledge.of_result(
                HybridCalibrator(self.uncertainty.space.robot).fit(rows), self.instrument
            )
        except ImplausibleError:
            raise
        except IdentificationError:  # too few rows
            return self.informed(rows.q)

    def informed(self, q: Float64[Tensor, "poses dof"]) -> "Knowledge":
        """Return what is known once poses are measured, whatever the values: `C' = R (1 + B^T B)^-1 R^T`.

        Args:
            q: commanded joint values [rad or m].
        """
        root = after_values(self.uncertainty.root, self.measured(q).flatten(0, 1))
        return replace(self, uncertainty=replace(self.uncertainty, covariance_root=CovarianceRoot(root)))

    def moved(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch dof"]:
        """Joint values with their most probable corrections [rad or m]."""
        if self.correction is None:
            return q
        with torch.no_grad():
            moved: Tensor = q + self.correction(q)
        return moved

    def columns(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses 6 unknowns"]:
        """Derivative of the target's position [m] and rotation vector [rad] in its frame by all unknowns."""
        return self.uncertainty.columns(JointState(q), self.moved(q))

    def tool(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses 3 directions"]:
        """Derivative D of the target's position by independent standard normal numbers: its covariance is `D D^T`.

        The position is that in the measuring frame, or where distances are measured in the robot's base frame, as these
        do not say where the robot stands. Of a camera, a shift and a turn of all poses together do not count: where
        the frame of a board stands, only the arm says, and only as far as the board is seen.
        """
        columns = self.columns(q)[:, :3]
        if self.instrument.sight is not None:
            points = forward_kinematics(self.uncertainty.geometry.robot, self.moved(q))[:, :3, 3]
            shifts = torch.eye(3).to(points).expand(len(points), 3, 3)
            rigid = torch.linalg.qr(torch.cat([shifts, skew(points - points.mean(0))], -1).flatten(0, 1)).Q
            flat = columns.flatten(0, 1)
            columns = (flat - rigid @ (rigid.t() @ flat)).view_as(columns)
        if self.instrument.kind == "distance":
            columns[..., [*self.uncertainty.space.of("base")]] = 0.0
        return self.uncertainty.covariance_root.along(columns)

    def measured(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses values directions"]:
        """Derivative B of what is measured, over its noise, by these numbers; values have covariance `B B^T + 1`."""
        return torch.cat([self._measured(some) for some in torch.split(q, CHUNK)])

    def _measured(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses values directions"]:
        columns, instrument = self.columns(q), self.instrument
        if instrument.kind == "distance":
            geometry = self.uncertainty.geometry
            away = forward_kinematics(geometry.robot, self.moved(q))[:, :3, 3] - q.new_tensor(
                instrument.anchor
            )
            columns = (away / away.norm(dim=1, keepdim=True))[:, None] @ columns[:, :3] / instrument.sigma
        elif instrument.kind == "position":
            columns = columns[:, :3] / instrument.sigma
        elif instrument.sight is not None:
            T = forward_kinematics(self.uncertainty.geometry.robot, self.moved(q))
            columns = instrument.sight.weight(T) @ columns
        else:
            noise = q.new_tensor([instrument.sigma] * 3 + [instrument.sigma_rotation] * 3)
            columns = columns / noise[:, None]
        return self.uncertainty.covariance_root.along(columns)

    def seen_anew(self, base: Float64[np.ndarray, " 6"], tool: Float64[np.ndarray, " 6"]) -> "Knowledge":
        """Return what is known of the same arm in another frame, at another target, of which nothing is known.

        Args:
            base: about where the robot's base is in that frame, as x, y, z, roll, pitch, yaw [m, rad].
            tool: about where the target is behind the last joint, likewise.
        """
        before = self.uncertainty
        robot = before.geometry.robot.with_geometry(base=base, tool=tool)
        geometry = IdentifiedGeometry(robot, {"": base}, {"": tool}, {})
        space = ParameterSpace(before.space.robot)
        arm, weights = before.root[: space.arm_size], before.root[len(before.space.parameters) :]
        wide = torch.diag(torch.tensor(WIDE, dtype=torch.float64))
        blank = arm.new_zeros(len(wide), arm.shape[1])
        beside = [rows.new_zeros(len(rows), len(wide)) for rows in (arm, weights)]
        rows = [torch.cat(pair, 1) for pair in ((arm, beside[0]), (blank, wide), (weights, beside[1]))]
        root = CovarianceRoot(torch.cat(rows))
        return replace(
            self, uncertainty=replace(before, space=space, geometry=geometry, covariance_root=root)
        )

    def deviation(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, " poses"]:
        """Standard deviation of the predicted position [m], `sqrt(σx² + σy² + σz²)`."""
        return self.tool(q).square().sum((1, 2)).sqrt()

    def surprise(self, rows: Measurements) -> Float64[Tensor, " rows"]:
        """Say how unlikely measured rows are: the length of `(B B^T + 1)^-1/2 r` over the root of its values.

        r is what was measured minus what is predicted, over the noise. A row that fits has about 1; under the
        predictive distribution the square times the number of values is chi-squared.

        Args:
            rows: positions, or poses where the instrument measures poses, of the first target in the first frame.

        Returns:
            NaN for rows in which nothing of the kind was measured.

        Raises:
            MeasurementError: the instrument measures distances, or is a camera.
            IdentificationError: a row has a frame or a target that was not calibrated.
        """
        instrument, geometry = self.instrument, self.uncertainty.geometry
        if instrument.kind in ("distance", "camera") or rows.position is None:
            raise MeasurementError("positions were wanted to compare with the predicted ones, got none.")
        T = predicted_poses(
            geometry.robot, geometry.bases, geometry.tools, replace(rows, q=self.moved(rows.q))
        )
        r = (rows.position - T[:, :3, 3]) / instrument.sigma
        if instrument.kind == "pose" and rows.rotation is not None:
            turned = rotation_vector(rows.rotation @ T[:, :3, :3].mT) / instrument.sigma_rotation
            r = torch.cat([r, turned], 1)
        B = self.measured(rows.q)[:, : r.shape[1]]
        lower = torch.linalg.cholesky(B @ B.mT + torch.eye(r.shape[1]).to(r))
        white = torch.linalg.solve_triangular(lower, r[..., None], upper=False)[..., 0]
        surprise: Tensor = white.square().mean(1).sqrt()
        return surprise


def _geometric_sizes(space: ParameterSpace) -> Float64[Tensor, " parameters"]:
    """Standard deviations of all parameters of a robot that was never measured [m or rad]."""
    of_class, sizes = RobotClass.of(space.robot), []
    arm = zip(space.parameters[: space.arm_size], space.robot.dh.ravel().tolist(), strict=True)
    for parameter, value in arm:
        group = PriorGroup(prior_group_of(parameter.group, abs(value) > of_class.usual.length))
        sizes.append(of_class.usual.of(group))
    return torch.tensor([*sizes, *WIDE], dtype=torch.float64)


def _weight_sizes(feature: AbstractFeature, of_groups: tuple[float, ...]) -> Float64[Tensor, " weights"]:
    """Standard deviations of the used weights of a feature [rad, or m of prismatic joints]."""
    sizes = torch.tensor(of_groups, dtype=torch.float64)[feature.group]
    unit = torch.where(torch.tensor(feature.robot.revolute), 1.0, feature.robot.reach)
    return (sizes * unit[:, None])[feature.used]

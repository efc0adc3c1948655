"""Joint offsets alone: the most that a controller can take which knows nothing but its zero positions."""

from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import ModelError
from pisigma.export.dh_table import TABLE_SUFFIXES, cells, csv_table, head
from pisigma.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.export.geometry import offset_remarks
from pisigma.kinematics.forward import forward_kinematics
from pisigma.kinematics.jacobian import joint_jacobian
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, in_file_units
from pisigma.se3 import (
    pose_error,
    rotation_from_vector,
    rotation_vector,
    skew,
    transform,
    transform_from_xyzrpy,
    xyzrpy_from_transform,
)
from pisigma.yaml_file import yaml_text

ITERATIONS = 50
UNOBSERVABLE = 1e-6
"""A joint's column whose part outside those of base and tool is a smaller share of it determines nothing."""
NO_EFFECT = 1e-4
"""Directions of the unknowns whose effect is smaller than this share of the largest are not moved along: base and
tool would run away for next to nothing."""
SETTLED = 1e-12


@dataclass(frozen=True, eq=False)
class OffsetProblem:
    """Bring a robot to poses by moving its joints' zero positions, its base and its tool.

    Attributes:
        robot: the robot to begin with.
        q: joint values [rad or m] of the poses.
        T: where the tool shall be then.
    """

    robot: Robot
    q: Float64[Tensor, "poses dof"]
    T: Float64[Tensor, "poses 4 4"]

    @property
    def lever(self) -> float:
        """Length [m] that makes an angle [rad] count as much as a distance: half a reach."""
        return self.robot.reach / 2

    def residual(self, robot: Robot) -> tuple[Float64[Tensor, " values"], Float64[Tensor, "values unknowns"]]:
        """What is missing [m], and its derivative by joints [rad or m], base and tool [m, rad].

        Base and tool count as small shifts and turns, of the base in the frame that poses are given in, of the
        tool in its own.
        """
        T, J = joint_jacobian(robot, self.q)
        R, p = T[:, :3, :3], T[:, :3, 3]
        eye, none = torch.eye(3).to(R).expand_as(R), torch.zeros_like(R)
        shifts = torch.cat([J[:, :3], eye, -skew(p), R, none], -1)
        turns = self.lever * torch.cat([J[:, 3:], none, eye, none, R], -1)
        missing = pose_error(self.T, T)
        missing = torch.cat([missing[:, :3], self.lever * missing[:, 3:]], -1)
        return missing.flatten(), torch.cat([shifts, turns], 1).flatten(0, 1)

    def moved(self, robot: Robot, step: Float64[Tensor, " unknowns"]) -> Robot:
        """The robot with joint offsets, base and tool changed by a step."""
        dof = robot.dof
        dh = robot.dh.copy()
        for joint, row, change in zip(robot.joints, robot.joint_rows, step[:dof].tolist(), strict=True):
            dh[row, 0 if joint.type == "revolute" else 1] += joint.direction * change
        base, tool = (transform_from_xyzrpy(torch.from_numpy(f.copy())) for f in (robot.base, robot.tool))
        base, tool = _small(step[dof : dof + 6]) @ base, tool @ _small(step[dof + 6 :])
        return robot.with_geometry(
            dh, xyzrpy_from_transform(base).numpy(), xyzrpy_from_transform(tool).numpy()
        )


def solve_offsets(problem: OffsetProblem) -> tuple[Robot, tuple[bool, ...]]:
    """Minimise the sum of squares by damped Gauss-Newton steps (Levenberg-Marquardt) from the robot as it is.

    Returns:
        The robot, and for every joint whether its offset can be determined beside base and tool; else it is left 0.
    """
    robot = problem.robot
    missing, J = problem.residual(robot)
    observable = _observable(J, robot.dof)
    free = torch.tensor([*observable, *[True] * 12])
    damping = 1e-3
    for _ in range(ITERATIONS):
        step = torch.zeros(len(free), dtype=torch.float64)
        step[free] = _step(J[:, free], missing, damping)
        there = problem.moved(robot, step)
        left, J_there = problem.residual(there)
        if left @ left < missing @ missing:
            settled = float(step.abs().max()) < SETTLED
            robot, missing, J, damping = there, left, J_there, damping / 10
            if settled:
                break
        elif damping > 1e6 or float(step.abs().max()) < SETTLED:
            break
        else:
            damping *= 10
    return robot, observable


def _step(
    J: Float64[Tensor, "values _free"], missing: Float64[Tensor, " values"], damping: float
) -> Float64[Tensor, " _free"]:
    """Damped step by the singular values of the column-scaled derivative."""
    scale = J.norm(dim=0).clamp(min=1e-12)
    U, s, V = torch.linalg.svd(J / scale, full_matrices=False)
    gain = torch.where(s > NO_EFFECT * s[0], s / (s.square() + damping * s[0].square()), 0.0)
    step: Tensor = V.mT @ (gain * (U.mT @ missing)) / scale
    return step


def _observable(J: Float64[Tensor, "values unknowns"], dof: int) -> tuple[bool, ...]:
    """For every joint whether its column is no combination of those of base, tool and the joints before."""
    others, observable = J[:, dof:] / J[:, dof:].norm(dim=0).clamp(min=1e-12), []
    for column in J[:, :dof].unbind(1):
        column = column / column.norm()
        U, s, _ = torch.linalg.svd(others, full_matrices=False)
        basis = U[:, s > UNOBSERVABLE * s[0]]
        observable.append(bool((column - basis @ (basis.mT @ column)).norm() > UNOBSERVABLE))
        if observable[-1]:
            others = torch.cat([others, column[:, None]], 1)
    return tuple(observable)


def _small(step: Float64[Tensor, " 6"]) -> Float64[Tensor, "4 4"]:
    return transform(rotation_from_vector(step[3:]), step[:3])


POSES = 1_000
"""Poses that the offsets are fitted to, and as many others that they are judged by."""


@dataclass(frozen=True)
class Departure:
    """How far a robot's tool is from where the whole model has it.

    Attributes:
        mean_mm: of the distances [mm].
        p95_mm: their 95 % quantile [mm].
        max_mm: the largest [mm].
        mean_mrad: mean angle between the two rotations [mrad].
    """

    mean_mm: float
    p95_mm: float
    max_mm: float
    mean_mrad: float


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """The robot as drawn with the joint offsets, base and tool that come nearest to a model.

    Attributes:
        robot: as drawn but for theta of turning and d of sliding joints, base and tool.
        values: per joint [rad or m], as the controller counts: the real robot commanded to q stands where the
            drawn one stands at q + offset.
        unobservable: joints whose offset is 0 because base or tool take the same in.
        lost: what is given up: departure from the whole model.
        nominal: the departure of the robot as drawn, with the model's base and tool, for comparison.
    """

    robot: Robot
    values: Float64[np.ndarray, " dof"]
    unobservable: tuple[str, ...]
    lost: Departure
    nominal: Departure

    def departures(self) -> dict[str, object]:
        """Both departures, by their keys in files."""
        return {"off_the_whole_model": asdict(self.lost), "robot_as_drawn": asdict(self.nominal)}


def fit_joint_offsets(model: CalibratedModel, seed: int = 0) -> JointOffsets:
    """Fit joint offsets, base and tool of the robot as drawn to a model by least squares.

    An angle counts as much as the distance that it makes at half the robot's reach.

    The poses are those of the model over the region that it was calibrated in: at its stored joint values and
    between random two of them. The figures are of other poses than were fitted.

    Args:
        model: the model.
        seed: of the draw.

    Raises:
        ModelError: the model stores no joint values, or predicts none of their poses.
    """
    generator = torch.Generator().manual_seed(seed)
    fitted, observable = solve_offsets(OffsetProblem(model.robot, *_poses(model, generator)))
    q, T = _poses(model, generator)
    return JointOffsets(
        robot=fitted,
        values=_offsets(model.robot, fitted),
        unobservable=tuple(
            j.name for j, free in zip(model.robot.joints, observable, strict=True) if not free
        ),
        lost=_departure(forward_kinematics(fitted, q), T),
        nominal=_departure(forward_kinematics(model.robot, q), T),
    )


def _poses(
    model: CalibratedModel, generator: torch.Generator
) -> tuple[Float64[Tensor, "poses dof"], Float64[Tensor, "poses 4 4"]]:
    """Joint values within the calibrated region, and where the model has the tool there."""
    starts = model.starts
    if not len(starts):
        raise ModelError(
            f"model {model.name} stores no joint values, so its region is not known; train it again."
        )
    pair = torch.randint(len(starts), (2, POSES), generator=generator)
    share = torch.rand((POSES, 1), generator=generator, dtype=torch.float64)
    q = starts[pair[0]] + share * (starts[pair[1]] - starts[pair[0]])
    T = model.forward(q)
    usable = torch.isfinite(T).flatten(1).all(-1)
    if model.network is not None and model.domain is not None:
        with torch.no_grad():
            usable &= model.domain.contains(model.network.scaled_inputs(T, q))
    if not usable.any():
        raise ModelError(
            f"model {model.name} predicts no pose between the joint values that it stores; train it again."
        )
    return q[usable], T[usable]


def _offsets(nominal: Robot, fitted: Robot) -> Float64[np.ndarray, " dof"]:
    offsets = [
        joint.direction * (fitted.dh[row] - nominal.dh[row])[0 if joint.type == "revolute" else 1]
        for joint, row in zip(nominal.joints, nominal.joint_rows, strict=True)
    ]
    return np.array(offsets)


def _departure(T: Float64[Tensor, "poses 4 4"], T_model: Float64[Tensor, "poses 4 4"]) -> Departure:
    distance = (T[:, :3, 3] - T_model[:, :3, 3]).norm(dim=-1)
    angle = rotation_vector(T[:, :3, :3].mT @ T_model[:, :3, :3]).norm(dim=-1)
    return Departure(
        mean_mm=float(distance.mean()) * 1e3,
        p95_mm=float(distance.quantile(0.95)) * 1e3,
        max_mm=float(distance.max()) * 1e3,
        mean_mrad=float(angle.mean()) * 1e3,
    )


MEANING = (
    "The real robot commanded to q stands where the robot as drawn stands at q + offset: command q - offset, "
    "or put the offset into the controller's zero positions. Base and tool were fitted anew for this."
)


def offset_sentences(offsets: JointOffsets) -> tuple[str, ...]:
    """What the offsets mean and what they give up."""
    lost, nominal = offsets.lost, offsets.nominal
    said = [
        MEANING,
        f"Offsets alone are off the whole model by {lost.mean_mm:.4g} mm in the mean, {lost.p95_mm:.4g} mm in 95 "
        f"% of its poses, {lost.max_mm:.4g} mm at most, and {lost.mean_mrad:.4g} mrad in the mean (the robot as "
        f"drawn, on the model's base and tool: {nominal.mean_mm:.4g}, {nominal.p95_mm:.4g}, "
        f"{nominal.max_mm:.4g} mm and {nominal.mean_mrad:.4g} mrad).",
    ]
    if offsets.unobservable:
        said.append(f"Base or tool take in the offset of {', '.join(offsets.unobservable)}, which is 0 here.")
    return tuple(said)


def offsets_csv(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """One line a joint, then base and tool; cells that do not apply are empty."""
    frame = in_file_units(FRAME_COLUMNS, offsets.robot.base)
    columns = ("part", "name", "type", "offset_deg", "offset_mm", *frame)
    lines = [{"part": "joint", **entry} for entry in _joints(offsets)]
    lines += [{"part": p, **cells(FRAME_COLUMNS, getattr(offsets.robot, p))} for p in ("base", "tool")]
    return csv_table(columns, lines, (*comments, *offset_sentences(offsets)))


def offsets_yaml(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """Offsets, base, tool and what they give up."""
    document: dict[str, object] = {"robot": offsets.robot.name, "joints": _joints(offsets)}
    for part in ("base", "tool"):
        document[part] = in_file_units(FRAME_COLUMNS, getattr(offsets.robot, part))
    body = yaml_text(document | offsets.departures())
    return head((*comments, *offset_sentences(offsets))) + body


def _joints(offsets: JointOffsets) -> list[dict[str, object]]:
    return [
        {"name": joint.name, "type": joint.type, f"offset_{joint.file_unit}": joint.in_file_unit(value)}
        for joint, value in zip(offsets.robot.joints, offsets.values, strict=True)
    ]


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    offsets, said = fit_joint_offsets(model), offset_remarks(model)
    text = (offsets_csv if request.as_csv else offsets_yaml)(offsets, said)
    return Exported(text, model_facts(model) | offsets.departures(), (*said, *offset_sentences(offsets)))


FORMAT = ExportFormat(
    "offsets", "a table of joint offsets", TABLE_SUFFIXES, _write, frozenset(("payload_kg", "temperature_c"))
)

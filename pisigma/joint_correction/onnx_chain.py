"""Forward kinematics of a nominal robot as ONNX nodes."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.components import IDENTITY, as_transform, compose_row
from pisigma.robot.row import Row
from pisigma.robot.se3 import transform_from_xyz_zyx


class _Step(NamedTuple):
    """A row of the chain, with the frames `(batch, 4, 4)` before and after it."""

    row: Row
    before: str
    after: str


def add_pose(graph: OnnxGraph, robot: Robot, q: str) -> tuple[str, str]:
    """Add the position `(batch, 3)` of T_base_tool and the entries of its rotation `(batch, 9)`, row-major."""
    (*_, last) = _add_chain(graph, robot, q, _matrix(robot.base))
    cells = graph.reshape(graph.add_node("MatMul", last.after, _matrix(robot.tool)), [16])
    return graph.columns(cells, [3, 7, 11]), graph.columns(cells, [0, 1, 2, 4, 5, 6, 8, 9, 10])


def add_joint_frames(graph: OnnxGraph, robot: Robot, q: str) -> tuple[str, str, str]:
    """Add axes `(batch, dof, 3)` and origins `(batch, dof, 3)` of the joints, and frames of their rows.

    All vectors are in the frame of the first row, without base and tool. The frames `(batch, 4 dof, 3)` are the
    origin and the three axes of every joint's row.
    """
    node, dof = graph.add_node, robot.dof
    steps = [step for step in _add_chain(graph, robot, q, np.eye(4)) if step.row.type != "fixed"]
    before = [graph.reshape(step.before, [16]) for step in steps]
    after = [graph.reshape(step.after, [16]) for step in steps]
    axes = node("Concat", *(graph.columns(cells, [2, 6, 10]) for cells in before), axis=1)
    origins = node("Concat", *(graph.columns(cells, [3, 7, 11]) for cells in before), axis=1)
    order = [3, 7, 11, 0, 4, 8, 1, 5, 9, 2, 6, 10]  # origin and the three axes
    carried = node("Concat", *(graph.columns(cells, order) for cells in after), axis=1)
    return (
        graph.reshape(axes, [dof, 3]),
        graph.reshape(origins, [dof, 3]),
        graph.reshape(carried, [4 * dof, 3]),
    )


def add_roll_pitch_yaw(graph: OnnxGraph, cells: str) -> list[str]:
    """Add roll, pitch and yaw, each `(batch, 1)`, of rotations `(batch, 9)`; see `robot.se3.zyx_from_rotation`."""
    node = graph.add_node
    entry = {(i, j): graph.column(cells, 3 * i + j) for i in range(3) for j in range(3)}
    square = node("Add", *(node("Mul", entry[i, 0], entry[i, 0]) for i in range(2)))
    regular = node("Greater", square, 1e-24)
    horizontal = node("Where", regular, node("Sqrt", square), 0.0)
    pitch = graph.angle(node("Neg", entry[2, 0]), horizontal)
    sine = node("Where", regular, entry[1, 0], node("Neg", entry[0, 1]))
    roll = graph.angle(sine, node("Where", regular, entry[0, 0], entry[1, 1]))
    yaw = graph.angle(node("Where", regular, entry[2, 1], 0.0), node("Where", regular, entry[2, 2], 1.0))
    return [roll, pitch, yaw]


def _add_chain(graph: OnnxGraph, robot: Robot, q: str, base: np.ndarray) -> Iterator[_Step]:
    """Yield the rows of the chain, adding `RotZ(q)` or `Trans(0, 0, q)` and the constant transform of each row."""
    # expanded to the batch size of q
    ones = graph.add_node("Add", graph.add_node("Mul", graph.column(q, 0), 0.0), 1.0)
    frame, joint = graph.add_node("Mul", graph.reshape(ones, [1, 1]), base), 0
    for row, still in zip(robot.rows, _still(robot), strict=True):
        before = frame
        if row.type != "fixed":
            value = graph.reshape(graph.add_node("Mul", graph.column(q, joint), float(row.direction)), [1, 1])
            frame = graph.add_node("MatMul", frame, _combined(graph, value, _moving(row)))
            joint += 1
        frame = graph.add_node("MatMul", frame, still)
        yield _Step(row, before, frame)


def _moving(row: Row) -> list[np.ndarray]:
    """Return the matrices whose sum times 1, cos q, sin q is `RotZ(q)`, or times 1, q is `Trans(0, 0, q)`."""
    if row.type == "prismatic":
        along = np.zeros((4, 4))
        along[2, 3] = 1.0
        return [np.eye(4), along]
    crossed = np.zeros((4, 4))
    crossed[1, 0], crossed[0, 1] = 1.0, -1.0
    return [np.diag([0.0, 0.0, 1.0, 1.0]), np.diag([1.0, 1.0, 0.0, 0.0]), crossed]


def _combined(graph: OnnxGraph, value: str, parts: Sequence[np.ndarray]) -> str:
    """Add the sum of `_moving` at joint values `(batch, 1, 1)`, as `(batch, 4, 4)`."""
    constant, *others = parts
    factors = [value] if len(others) == 1 else [graph.add_node("Cos", value), graph.add_node("Sin", value)]
    total = ""
    for factor, part in zip(factors, others, strict=True):
        term = graph.add_node("Mul", factor, part)
        total = graph.add_node("Add", total, term) if total else term
    return graph.add_node("Add", total, constant)


def _still(robot: Robot) -> list[np.ndarray]:
    """Return the transform of every row at joint value 0."""
    like = torch.zeros((), dtype=torch.float64)
    return [as_transform(compose_row(IDENTITY, row), like).numpy() for row in robot.dh.tolist()]


def _matrix(frame: np.ndarray) -> np.ndarray:
    matrix: np.ndarray = transform_from_xyz_zyx(torch.from_numpy(frame.copy())).numpy()
    return matrix

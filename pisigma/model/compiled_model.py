"""A calibrated model as plain arrays for the compiled inverse kinematics."""

import math
import os

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.errors import ModelError
from pisigma.hybrid.arms import HybridArm
from pisigma.joint_correction.feature import scaled_joints, turning_rate
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.kernels.arrays import (
    DRAWN,
    FIXED,
    GEOMETRIC,
    HYBRID,
    NO_CLOSED_FORM,
    NOMINAL,
    PRISMATIC,
    REVOLUTE,
    SCARA,
    SPHERICAL_WRIST,
    THREE_PARALLEL,
    Arms,
    ClosedForm,
    Correction,
    Coverage,
    Description,
    Starts,
)
from pisigma.kernels.description_file import write_description
from pisigma.kinematics.closed_form import AbstractClosedForm, closed_form_solver
from pisigma.kinematics.closed_form.scara import Scara
from pisigma.kinematics.closed_form.spherical_wrist import SphericalWristArm
from pisigma.kinematics.closed_form.three_parallel import ThreeParallelArm
from pisigma.kinematics.components import cosine_sine
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.compiled_network import describe_network
from pisigma.model.stored_starts import StoredStarts
from pisigma.robot.description import Robot
from pisigma.se3 import invert, transform_from_xyzrpy

_KINDS = {"fixed": FIXED, "revolute": REVOLUTE, "prismatic": PRISMATIC}
_FORMS = {Scara: SCARA, SphericalWristArm: SPHERICAL_WRIST, ThreeParallelArm: THREE_PARALLEL}
_NUMERIC = ("numeric",)


def save_compiled(model: CalibratedModel, file: str | os.PathLike[str], belongs_to: str = "") -> None:
    """Write what `CompiledIK.load` reads.

    Args:
        model: the model.
        file: to write.
        belongs_to: `folder_hash` of the folder that says the same, kept in the file: one with another is stale.

    Raises:
        ModelError: see `describe`.
    """
    description, branches = describe(model)
    joints = [joint.name for joint in model.robot.joints]
    write_description(
        file, description, branches=branches, joints=joints, name=model.name, belongs_to=belongs_to
    )


def describe(model: CalibratedModel) -> tuple[Description, tuple[str, ...]]:
    """A model as arrays, and the names of its branches.

    Raises:
        ModelError: the model has a network and an identified geometry, its learned correction uses features without
            compiled form, or it has neither a closed-form inverse nor joint values to start from.
    """
    if model.network is not None and model.calibrated is not None:
        raise ModelError(
            f"model '{model.name}': it has an identified geometry and a network that corrects nominal joint values, "
            "which has no compiled form; leave one out."
        )
    solver = closed_form_solver(model.robot)
    if solver is None and not len(model.starts):
        raise ModelError(
            f"model '{model.name}': its robot has no closed-form inverse, and the model holds no joint values to "
            "start from; calibrate it again."
        )
    geometric = model.calibrated or model.robot
    correction, features = _correction(model)
    description = Description(
        arms=_arms(model.robot, geometric, model.hybrid),
        correction=correction,
        features=features,
        coverage=_coverage(geometric, model.hybrid),
        network=describe_network(model),
        closed_form=_closed_form(model, solver),
        starts=_starts(geometric, model),
    )
    return description, solver.branches if solver else _NUMERIC


def _arms(nominal: Robot, geometric: Robot, hybrid: HybridArm | None) -> Arms:
    arms = {NOMINAL: nominal, GEOMETRIC: geometric, HYBRID: geometric, DRAWN: nominal}
    if hybrid is not None:
        arms |= {GEOMETRIC: hybrid.geometric, HYBRID: hybrid.hybrid, DRAWN: hybrid.correction.robot}
    ordered = [arms[index] for index in range(4)]
    ends = [
        [transform_from_xyzrpy(torch.from_numpy(end.copy()))[:3].numpy() for end in (arm.base, arm.tool)]
        for arm in ordered
    ]
    return Arms(
        kind=np.array([_KINDS[row.type] for row in nominal.rows]),
        rows=np.stack([_rows(arm) for arm in ordered]),
        ends=np.array(ends),
        reach=np.array([arm.reach or 1.0 for arm in ordered]),
        direction=nominal.directions,
        revolute=np.array(nominal.revolute, dtype=np.int64),
        limits=nominal.limits,
        hybrid=int(hybrid is not None),
    )


def _rows(arm: Robot) -> Float64[np.ndarray, "rows 9"]:
    rows = []
    for theta, d, a, alpha, beta in arm.dh.tolist():
        rows.append([theta, d, a, *cosine_sine(alpha), *cosine_sine(beta), *cosine_sine(theta)])
    return np.array(rows, dtype=np.float64)


def _correction(model: CalibratedModel) -> tuple[Correction, tuple[str, ...]]:
    """The joint correction of a model, and the names of its features in the order of their numbers.

    Raises:
        ModelError: a feature has no compiled form, or two have the same name.
    """
    dof, hybrid = model.robot.dof, model.hybrid
    robot = model.robot if hybrid is None else hybrid.correction.robot
    zero = scaled_joints(robot, torch.from_numpy(np.zeros(dof))).numpy()
    half = 1 / (scaled_joints(robot, torch.from_numpy(np.ones(dof))).numpy() - zero)
    correction = JointCorrection(robot, ()) if hybrid is None else hybrid.correction
    numbers: dict[str, np.ndarray] = {}
    for feature, weight in zip(correction.features, correction.linear, strict=True):
        if feature.compiled is not None and feature.name not in numbers:
            numbers[feature.name] = feature.pack(weight.detach().numpy())
        elif not feature.usually_zero:
            raise ModelError(
                f"model '{model.name}': its correction uses the feature '{feature.name}', which has no compiled form "
                "(or stands twice)."
            )
    fixed, starts = correction.fixed.numpy(), np.cumsum([0, *(len(values) for values in numbers.values())])
    compiled = Correction(
        rate=turning_rate(robot),
        middle=-zero * half,
        half=half,
        values=np.concatenate([np.zeros(0), *numbers.values()]),
        starts=starts[:-1].astype(np.int64),
        weight=(correction.weight.detach().numpy() * fixed[..., None]).transpose(1, 2, 0).copy(),
        bias=(correction.bias.detach().numpy() * fixed).T.copy(),
        orders=np.array(correction.orders, dtype=np.int64),
        periodic=int(correction.is_periodic),
        frames=int(
            any(feature.compiled is not None and feature.compiled.frames for feature in correction.features)
        ),
    )
    return compiled, tuple(numbers)


def _coverage(robot: Robot, hybrid: HybridArm | None) -> Coverage:
    if hybrid is None:
        none = np.zeros(0)
        return Coverage(np.zeros(0, dtype=np.int64), none, none, turning_rate(robot), 1.0)
    own = hybrid.coverage
    return Coverage(
        own.joint.numpy(), own.middle.numpy(), own.half.numpy(), own.rate.numpy(), float(own.fade)
    )


def _closed_form(model: CalibratedModel, solver: AbstractClosedForm | None) -> ClosedForm:
    dof, none = model.robot.dof, np.zeros((3, 4))
    if solver is None:
        zeros = np.zeros(dof)
        return ClosedForm(
            NO_CLOSED_FORM,
            1,
            np.zeros(1, dtype=np.int64),
            1,
            none,
            none,
            zeros,
            zeros,
            zeros,
            zeros,
            zeros,
            zeros,
        )
    rows, names = solver.rows, solver.branches
    trained = [names.index(name) for name in model.branches] or list(range(len(names)))
    return ClosedForm(
        kind=_FORMS[type(solver)],
        branches=len(names),
        order=np.array([*trained, *(index for index in range(len(names)) if index not in trained)]),
        trained=len(trained),
        first=invert(rows.T_base_first)[:3].numpy(),
        last=invert(rows.T_last_tool)[:3].numpy(),
        sign=rows.sign.numpy(),
        direction=rows.direction.numpy(),
        offset=rows.offset.numpy(),
        theta=np.array(rows.theta),
        d=np.array(rows.d),
        a=np.array(rows.a),
    )


def _starts(robot: Robot, model: CalibratedModel) -> Starts:
    lever = robot.reach / 2 / math.sqrt(2)
    stored = StoredStarts(robot, model.starts.double().cpu())
    T = stored.T.numpy()
    points = np.concatenate([T[:, :3, 3], lever * T[:, :3, :3].reshape(-1, 9)], axis=1)
    return Starts(stored.q.numpy(), points, lever)

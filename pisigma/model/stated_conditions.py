"""Hybrid models at a stated payload and temperature, and warnings if these are outside the measured range."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import ModelError
from pisigma.joint_correction.conditions import (
    ConditionFeatures,
    at_conditions,
    at_torques,
    learned_conditions,
    learned_torques,
)
from pisigma.joint_correction.joint_torques import JointTorques
from pisigma.measurement.conditions import JointState, conditions_of
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.rules import TEMPERATURES
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot

_BEYOND = {
    "payload_kg": "the effect of the payload is extrapolated linearly",
    "temperature_c": "the correction stays that of the nearest measured temperature",
}
"""Clause about the extrapolation of a model outside the measured values of a condition."""
_MIN_TORQUES = 5
"""Number of rows with a torque of a joint above which its sign and unit are compared with the calibration."""
_MAX_TORQUE_RATIO = 5.0
"""Largest ratio of measured to modelled torques, or of modelled to measured torques, that a different load explains."""


def under_stated_conditions(
    model: CalibratedModel, payload_kg: float | None = None, temperature_c: float | None = None
) -> CalibratedModel:
    """Return the model at fixed conditions, as a function of the joint values alone.

    See `pisigma.joint_correction.conditions.at_conditions`; constant joint shifts are added to the joint offsets of the
    geometry. `condition_warnings` warns about conditions outside the measured range.

    Args:
        model: hybrid model, calibrated with rows that state the conditions given here.
        payload_kg: mass that the robot carries [kg]; None for the mean of the calibration rows.
        temperature_c: temperature of the robot [deg C]; None for the mean of the calibration rows.

    Raises:
        ModelError: the model did not learn the effect of a given condition, or the value is not possible.
    """
    given = {"payload_kg": payload_kg, "temperature_c": temperature_c}
    stated = {name: value for name, value in given.items() if value is not None}
    if not stated:
        return model
    arm, learned = model.hybrid, _learned(model)
    names = () if learned is None else learned.names
    for name, value in stated.items():
        if name not in names:
            raise ModelError(
                f"model '{model.name}' did not learn the effect of {name}, only of "
                f"{', '.join(('joint values', *names))}",
                value=value,
                option=name,
                remedy=f"calibrate with rows measured at several values of {name} (a column of that name)",
            )
        low, high = TEMPERATURES if name == "temperature_c" else (0.0, math.inf)
        if not math.isfinite(value) or not low <= value <= high:
            expected = (
                "a mass >= 0 kg" if high == math.inf else f"a temperature from {low:g} to {high:g} deg C"
            )
            raise ModelError(expected=expected, value=value, option=name)
    assert arm is not None
    assert learned is not None
    usual = dict(zip(learned.names, learned.mean, strict=True))
    values = torch.tensor([{**usual, **stated}[name] for name in learned.names], dtype=torch.float64)
    correction, shift = at_conditions(arm.correction, learned.scaled_conditions(values))
    under = replace(arm, robot=_shifted(arm.robot, shift), correction=correction)
    measured = {
        name: ends for name, ends in zip(learned.names, learned.measured, strict=True) if name in stated
    }
    return replace(
        model,
        hybrid=under,
        conditions={**usual, **stated},
        measured_conditions=measured,
        condition_correction=arm.correction,
    )


def under_stated_torques(model: CalibratedModel, torques_nm: Sequence[float]) -> CalibratedModel:
    """Return the model with constant deflections of the joints due to stated torques.

    Args:
        model: hybrid model, calibrated on rows with joint torques.
        torques_nm: torques of all drives at the pose [Nm; N for prismatic joints], see `JointTorques`.

    Raises:
        ModelError: the model did not learn the effect of torques, or a torque is missing, not finite, or larger than
            any load explains.
    """
    arm = model.hybrid
    learned = None if arm is None else learned_torques(arm.correction)
    if arm is None or learned is None:
        raise ModelError(
            f"model '{model.name}' did not learn the effect of joint torques",
            option="torques_nm",
            remedy="calibrate with rows that state them (columns tau_1, tau_2, ...)",
        )
    values = np.asarray(torques_nm, dtype=np.float64)
    if values.shape != (model.robot.dof,) or not np.isfinite(values).all():
        raise ModelError(
            expected=f"{model.robot.dof} finite torques, one per joint", value=torques_nm, option="torques_nm"
        )
    usual = learned.modelled_torques(JointState(model.starts.double())).abs().numpy().max(0, initial=0.0)
    largest = _MAX_TORQUE_RATIO * (usual + np.sqrt(np.diag(learned.covariance)))
    beyond = np.flatnonzero((np.abs(values) > largest) & (np.array(learned.scale) > 0))
    if len(beyond) and len(model.starts):
        joint = int(beyond[0])
        raise ModelError(
            expected=f"a torque of at most {largest[joint]:.3g} Nm at joint {joint + 1}, {_MAX_TORQUE_RATIO:g} "
            "times the largest in the calibration",
            value=float(values[joint]),
            option="torques_nm",
            remedy="give torques in Nm (forces in N for prismatic joints)",
        )
    correction, shift = at_torques(arm.correction, values)
    return replace(model, hybrid=replace(arm, robot=_shifted(arm.robot, shift), correction=correction))


def condition_warnings(model: CalibratedModel, rows: Measurements | None = None) -> tuple[str, ...]:
    """Return warnings about conditions outside the range of the calibration and about torques that differ from it.

    Args:
        model: model of any kind; only a hybrid learns the effect of conditions.
        rows: rows whose conditions are checked; None for the conditions at which the model is evaluated.
    """
    sentences = _torque_warning(model, rows)
    if rows is None:
        stated = [
            (name, *ends, torch.tensor([model.conditions[name]], dtype=torch.float64))
            for name, ends in model.measured_conditions.items()
        ]
    else:
        learned = _learned(model)
        if learned is None:
            return sentences
        columns = conditions_of(rows, learned.names).unbind(1)
        sentences += tuple(
            f"{int(values.isnan().sum())} of {rows.rows} rows do not state {name}, whose effect {model.name} corrects: "
            f"the mean of the calibration, {usual:.4g}, is used. The predicted accuracy includes deviations from it; "
            "add the column."
            for (name, usual), values in zip(mean_conditions(model).items(), columns, strict=True)
            if bool(values.isnan().any())
        )
        stated = [
            (name, low, high, values)
            for name, (low, high), values in zip(learned.names, learned.measured, columns, strict=True)
        ]
    beyond = (sentence for one in stated for sentence in _warning(*one, model.name, rows is None))
    return (*sentences, *beyond)


def _torque_warning(model: CalibratedModel, rows: Measurements | None) -> tuple[str, ...]:
    """Return the warning that modelled torques are used; empty if the model needs no torques or all rows state them."""
    learned = None if model.hybrid is None else learned_torques(model.hybrid.correction)
    if learned is None:
        return ()
    unlike: tuple[str, ...] = ()
    which = "no joint torques are stated"
    if rows is not None:
        needed = torch.tensor([scale > 0 for scale in learned.scale])
        missing = rows.rows
        if rows.torque is not None:
            missing = int(rows.torque[:, needed].isnan().any(1).sum())
            unlike = _unlike_torques(model.name, learned, rows)
        if not missing:
            return unlike
        which = f"{missing} of {rows.rows} rows do not state all joint torques (columns tau_1, ...)"
    return (
        *unlike,
        f"{which}, but {model.name} was calibrated with measured ones: gravity torques modelled from the joint values "
        "are used, with the mean load of the calibration. The predicted accuracy includes their deviation.",
    )


def _unlike_torques(name: str, learned: JointTorques, rows: Measurements) -> tuple[str, ...]:
    """Return a warning about torques whose sign or unit differs from that of the calibration.

    Measured torques are compared with modelled torques of joints that gravity loads more than differences of the load
    do.
    """
    assert rows.torque is not None
    modelled, unlike = learned.modelled_torques(JointState(rows.q)), list[str]()
    for joint, (tau, model, row) in enumerate(
        zip(rows.torque.t(), modelled.t(), learned.covariance, strict=True)
    ):
        stated = torch.isfinite(tau)
        size = float(model[stated].square().sum())
        if (
            int(stated.sum()) < _MIN_TORQUES
            or size <= 9 * row[joint] * int(stated.sum())
            or not learned.scale[joint]
        ):
            continue
        ratio = float(tau[stated] @ model[stated]) / size
        if not 1 / _MAX_TORQUE_RATIO <= ratio <= _MAX_TORQUE_RATIO:
            unlike.append(f"{ratio:.2g} times those in column tau_{joint + 1}")
    if not unlike:
        return ()
    return (
        f"expected torques with the sign and unit of the calibration of {name}, got {', '.join(unlike)}; convert the "
        "columns tau_1, ... of the rows.",
    )


def _warning(
    name: str, low: float, high: float, values: Float64[Tensor, " rows"], model: str, single: bool
) -> Sequence[str]:
    """Yield a warning about one condition if values are stated outside the measured range."""
    slack = 1e-9 * max(abs(low), abs(high), 1.0)
    beyond = values[(values < low - slack) | (values > high + slack)]
    if not len(beyond):
        return ()
    least, most = float(beyond.min()), float(beyond.max())
    span = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}"
    what = f"{name} {span}" if single else f"{len(beyond)} of {len(values)} rows have {name} {span}, which"
    return (
        f"{what} is outside {low:.4g} to {high:.4g}, the range of the calibration of {model}: {_BEYOND[name]}.",
    )


def _learned(model: CalibratedModel) -> ConditionFeatures | None:
    return None if model.hybrid is None else learned_conditions(model.hybrid.correction)


def _shifted(robot: Robot, shift: Float64[Tensor, " dof"]) -> Robot:
    """Return the robot with shifted joint offsets: its pose at q is that of the given robot at `q + shift`."""
    dh = robot.dh.copy()
    for row, is_revolute, direction, value in zip(
        robot.joint_rows, robot.revolute, robot.directions, shift.tolist(), strict=True
    ):
        dh[row, 0 if is_revolute else 1] += direction * value
    return robot.with_geometry(dh=dh)


def mean_conditions(model: CalibratedModel) -> dict[str, float]:
    """Return the means over the calibration rows [kg, deg C] of the conditions that a model corrects, by name."""
    learned = _learned(model)
    return {} if learned is None else dict(zip(learned.names, learned.mean, strict=True))


def learned_range(model: CalibratedModel, condition: str) -> tuple[float, float] | None:
    """Return the lowest and highest calibrated value of a condition that a model corrects; None if it does not.

    Args:
        model: model of any kind; only a hybrid learns the effect of conditions.
        condition: a name in `CONDITIONS`.
    """
    learned = _learned(model)
    return None if learned is None else dict(zip(learned.names, learned.measured, strict=True)).get(condition)

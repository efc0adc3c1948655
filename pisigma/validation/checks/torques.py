"""Check whether measured torques have the sign that the deflections of elastic joints require."""

from collections.abc import Iterator

import torch

from pisigma.joint_correction.joint_torques import JointTorques
from pisigma.robot.description import Robot
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

_SIGNIFICANT = 3.0
"""Ratio of a compliance to its standard deviation above which its sign is known."""


def check_torques(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about negative compliances: torques of the load instead of the drive, or torques of the wrong sign."""
    hybrid = checked.hybrid
    if hybrid is None or hybrid.learned is None:
        return
    weights = dict(zip(hybrid.learned.correction.features, hybrid.learned.correction.linear, strict=True))
    learned = next((own for own in weights if isinstance(own, JointTorques)), None)
    first = len(hybrid.uncertainty.space.parameters)
    for feature in hybrid.uncertainty.features:
        count = int(feature.used.sum())
        if feature is learned:
            deviation = torch.zeros_like(weights[feature])
            deviation[feature.used] = hybrid.uncertainty.dense_root[first : first + count].norm(dim=1)
            compliance = learned.compliances(weights[feature].detach())
            known = compliance.abs() > _SIGNIFICANT * learned.compliances(deviation).abs()
            yield from _negative(
                {joint: float(compliance[joint]) for joint in known.nonzero()[:, 0].tolist()}, checked.robot
            )
        first += count


def _negative(compliances: dict[int, float], robot: Robot) -> Iterator[Diagnostic]:
    """Warn if some of the compliances [rad/Nm or m/N] of joints are negative."""
    negative = {joint: value for joint, value in compliances.items() if value < 0}
    if not negative:
        return
    is_mixed = len(negative) < len(compliances)
    remedy = "Reverse their signs, in later rows too."
    units = ["rad/Nm" if revolute else "m/N" for revolute in robot.revolute]
    columns = ", ".join(f"tau_{joint + 1} ({value:.2g} {units[joint]})" for joint, value in negative.items())
    others = ", unlike that of the other columns" if is_mixed else ""
    yield Diagnostic(
        kind="torques",
        severity="warning",
        sentence=f"expected torques of the drives, positive towards larger joint values, got negative compliances "
        f"with the columns {columns}: their sign is probably reversed{others}. {remedy}",
        cause="mixed_signs" if is_mixed else "opposite_sign",
        values={"joints": tuple(joint + 1 for joint in negative)},
        remedy=remedy,
    )

"""Arms of one torso: the joints that they share, and models with one set of parameters for these joints."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pisigma.calibration.frames.shared_objects import ArmPosterior
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files.errors import IdentificationError
from pisigma.model.geometric_model import branches_of
from pisigma.robot.description import Robot
from pisigma.validation.held_out.calibration_summary import summarise
from pisigma.validation.held_out.trained_calibrations import geometric_result
from pisigma.workflow.calibrate import Calibration
from pisigma.workflow.settings.calibration import CalibrationSettings


def torso_joints(names: Sequence[str], robots: Sequence[Robot]) -> dict[str, tuple[str, ...]]:
    """Return, for every arm, the names of the first joints that it shares with other arms of the same URDF file.

    Two arms of one file with the same joints, such as two UR5s, are different robots.

    Args:
        names: names of the arms.
        robots: nominal robots of the arms.

    Raises:
        IdentificationError: the arms share joints that are not the first ones of both, a branch follows a prismatic
            joint, or there is another robot of this file.
    """
    torso: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())
    for number, (name, robot) in enumerate(zip(names, robots, strict=True)):
        for before, other in zip(names[:number], robots, strict=False):
            count = _shared_count(before, other, name, robot)
            if any(count and robot.rows == another.rows for another in robots[:number]):
                _refuse(
                    name, "arms of one torso, each with its own tip", "give each robot a URDF file of its own"
                )
            for own, of in ((name, robot), (before, other)):
                torso[own] = max(torso[own], tuple(row.name for row in of.rows[:count]), key=len)
    return torso


def _shared_count(before: str, other: Robot, name: str, robot: Robot) -> int:
    """Return the number of first joints that two arms of one URDF file share."""
    common = {row.name for row in robot.rows} & {row.name for row in other.rows}
    if robot.urdf is None or robot.urdf != other.urdf or not common or robot.rows == other.rows:
        return 0
    count = len(common)
    if not (
        {row.name for row in robot.rows[:count]} == {row.name for row in other.rows[:count]} == common
        and np.array_equal(robot.base, other.base)
        and np.allclose(robot.dh[: count - 1], other.dh[: count - 1], rtol=0.0, atol=1e-9)
    ):
        _refuse(name, f"the same first joints as arm '{before}'", "state the same `base` link for both arms")
    if robot.rows[count - 1].type == "prismatic":
        _refuse(
            name,
            f"a revolute joint before the branch to arm '{before}'",
            f"keep joint '{robot.rows[count - 1].name}' at rest, and state the link after it as the `base` of both",
        )
    return count


def _refuse(name: str, expected: str, remedy: str) -> None:
    raise IdentificationError(expected=expected, value=name, option="arms", remedy=remedy)


def torso_settings(name: str, settings: CalibrationSettings) -> CalibrationSettings:
    """Return the settings of an arm of a torso, which has no joint correction.

    A joint correction of a shared joint would be learned by every arm, and its load is that of all arms.

    Raises:
        IdentificationError: the settings name features of a joint correction.
    """
    if settings.features:
        raise IdentificationError(
            expected="no features of a joint correction for an arm of a torso",
            value=settings.features,
            option="features",
            remedy=f"omit `features`; arm '{name}' shares joints, whose correction cannot be learned by one arm",
        )
    return settings if settings.model == "geometric" else replace(settings, features=())


def with_common_joints(calibration: Calibration, posterior: ArmPosterior) -> Calibration:
    """Return the calibration of an arm with the values of a posterior that holds for all arms of its torso.

    Held-out errors remain those of the arm's own calibration, and so do the standard errors in its table.
    """
    result, model, geometry = calibration.result, calibration.model, posterior.uncertainty.geometry
    own = geometric_result(result)
    solved = replace(
        own.solved, geometry=replace(geometry, setup=own.solved.setup, point=own.solved.geometry.point)
    )
    common = solved.result()
    updated = replace(result, geometric=common) if isinstance(result, HybridResult) else common
    robot = model.robot.with_geometry(base=geometry.robot.base, tool=geometry.robot.tool)
    text = (
        f"{calibration.card_texts.description} Arms of one torso share its base and "
        f"{', '.join(posterior.torso_joints)}: their values are from the rows of all these arms, "
        "held-out errors and standard errors in tables from the rows of this arm only. There is no joint correction."
    )
    summary = calibration.summary.with_figures(parameters=summarise(updated).parameters)
    return replace(
        calibration,
        result=updated,
        summary=summary,
        card_texts=replace(calibration.card_texts, description=text),
        model=replace(
            model,
            robot=robot,
            branches=branches_of(robot, model.starts),
            calibrated=geometry.robot,
            bases=dict(geometry.bases),
            tools=dict(geometry.tools),
            uncertainty=model.uncertainty and posterior.uncertainty.with_rounded_root(calibration.rows),
            metrics=summary.to_json(),
        ),
    )

"""The one gate for rows: every command that takes some lets them be judged here, with the same words and status."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import MeasuredPoses, best_base_and_tool
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.checks.other_robot import other_robot_diagnostics
from pisigma.validation.checks.registry import ROW_CHECKS, diagnostics_of_rows
from pisigma.validation.checks.rows.other_sensors import diagnosed_lengths
from pisigma.validation.checks.rows.row_check import FITTED, Move, RowsUnderModel
from pisigma.validation.checks.setup_fault import setup_diagnostics
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.explanations import position_spread
from pisigma.validation.setup_faults.faults_as_drawn import FEWEST_ROWS_AS_DRAWN, largest_group, usual_error
from pisigma.validation.setup_faults.hypothesis import COLLAPSED
from pisigma.validation.setup_faults.joint_faults import joint_causes, signs_and_exchanges
from pisigma.validation.setup_faults.setup_fault import SetupFault

FEWEST_CHECKED = 12
"""From so many rows on a calibration says whether the errors of the arm are too large to be those of this robot."""
FEWEST_ROWS = 4
"""Of fewer, the positions may happen to be near each other."""
SCALE = 30.0
"""Positions are in another unit that are so many times as far apart as those of the robot as drawn."""
ARM_SHARE = 0.3
"""Share of the reach by which a tool that is not drawn spreads positions, and that poses are spread over at least."""

FEWEST_FOR_JOINTS = 8
"""Rows that tell columns of joints apart: 24 values, of which base and tool take 9."""


@dataclass(frozen=True, eq=False)
class RowVerdict:
    """What the checks say of rows.

    Attributes:
        diagnostics: those first that make the rows implausible.
        judged: the rows with what the model says of them; None where they were judged by the robot as drawn, or where
            too few of them have positions.
        faults_of_lengths: what explains the errors of rows without positions.
    """

    diagnostics: tuple[Diagnostic, ...] = ()
    judged: RowsUnderModel | None = None
    faults_of_lengths: tuple[SetupFault, ...] = ()

    @property
    def setup_faults(self) -> tuple[SetupFault, ...]:
        """What explains the errors of all rows alike, of any size, moves among it."""
        return self.faults_of_lengths if self.judged is None else self.judged.setup_faults

    @property
    def implausible(self) -> tuple[Diagnostic, ...]:
        """Why nothing is to be concluded from the rows: commands end with status 3."""
        return tuple(one for one in self.diagnostics if one.severity == "implausible")

    @property
    def trusted(self) -> bool:
        """Whether something may be concluded from the rows."""
        return not self.implausible


def check_rows(
    rows: Measurements,
    against: Robot | CalibratedModel,
    fitted: Collection[FrameKind] = (),
    may_move: Collection[Move] = (),
    nominal: CalibratedModel | None = None,
) -> RowVerdict:
    """Judge rows before anything is concluded from them.

    Against a model the checks of `ROW_CHECKS` are run, for rows without positions those of `diagnosed_lengths`.
    Against a robot as drawn, and the mean robot of a fleet, the size of the positions is compared with that of the
    robot's motion, from 6 rows on other robots of the catalogue are tried, from 8 on signs and exchanges of joint
    columns, from 12 on the rows are calibrated with and checked by `CHECKS`, and from 24 on for faults in the setup.

    Args:
        rows: any.
        against: a calibrated model, or the robot as drawn.
        fitted: what stands elsewhere than when the model was made, for certain.
        may_move: what else may have moved since, without being a fault of the rows.
        nominal: the nominal robot with the base and tool that suit it best; only shows what its errors fall to.

    Raises:
        MeasurementError: the model does not know a frame or a target of the rows.
        PoseError: the joint values do not fit the robot.
    """
    if isinstance(against, CalibratedModel) and against.kind == FLEET_PRIOR and against.drawn is not None:
        against = against.drawn
    if isinstance(against, Robot):
        return RowVerdict(_until_implausible(_against_robot(rows, against)))
    judged = RowsUnderModel.of(against, rows, fitted, may_move, nominal)
    if judged is None and rows.position is None:
        diagnostics, faults = diagnosed_lengths(against, rows, fitted, may_move)
        return RowVerdict(diagnostics, None, faults)
    if judged is None:
        return RowVerdict()
    return RowVerdict(_until_implausible(check.diagnose(judged) for check in ROW_CHECKS), judged)


def _until_implausible(checks: Iterable[Iterable[Diagnostic]]) -> tuple[Diagnostic, ...]:
    """What the checks say, up to the first that finds rows implausible: what the others say is a consequence."""
    found: list[Diagnostic] = []
    for diagnostics in checks:
        found += diagnostics
        if any(one.severity == "implausible" for one in found):
            break
    return tuple(sorted(found, key=lambda one: one.severity != "implausible"))


def _against_robot(rows: Measurements, robot: Robot) -> Iterator[Iterable[Diagnostic]]:
    """Checks by the robot as drawn, the surest first."""
    yield setup_diagnostics(robot, rows)
    yield size_of_positions(robot, rows)
    yield joint_columns(robot, rows)
    yield other_robot_diagnostics(robot, rows)
    if rows.rows >= FEWEST_CHECKED:
        yield _as_calibrated(rows, robot)


def _as_calibrated(rows: Measurements, robot: Robot) -> tuple[Diagnostic, ...]:
    """What is wrong with a calibration of the rows."""
    try:
        return diagnostics_of_rows(GeometricCalibrator(robot), rows)
    except IdentificationError as refusal:  # no calibration error explains the rows
        sentence = str(refusal).removeprefix(f"{rows.source}: ")
        return (Diagnostic(kind="implausible_errors", severity="implausible", sentence=sentence),)


def size_of_positions(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Compare the size of what was measured with that of the robot's motion."""
    group = largest_group(rows)
    if group.position is None or group.rows < FEWEST_ROWS:
        return
    measured, drawn = (
        position_spread(group.position),
        position_spread(forward_kinematics(robot, group.q)[:, :3, 3]),
    )
    arm = ARM_SHARE * robot.reach
    if measured > SCALE * (drawn + arm):
        mistake = "x, y and z are millimetres that are named metres"
    elif SCALE * measured < drawn > arm:
        mistake = "x, y and z are metres that are named millimetres, or do not change with the robot"
    else:
        return
    yield Diagnostic(
        kind="setup_fault",
        severity="implausible",
        sentence=f"The measured positions are {measured * 1e3:,.1f} mm RMS from their mean, and those of robot "
        f"'{robot.name}' at these joint values {drawn * 1e3:,.1f} mm: {mistake}; check the column names and the "
        "instrument.",
    )


def joint_columns(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Try a reversed sign of every joint and an exchange of two neighbours, base and tool being fitted each time.

    Of more rows than `FEWEST_ROWS_AS_DRAWN` much more is tried, see `find_faults_as_drawn`.
    """
    group = largest_group(rows)
    if not FEWEST_FOR_JOINTS <= group.rows < FEWEST_ROWS_AS_DRAWN:
        return
    here, usual = _errors(robot, group, group.q[None])[0], usual_error(robot, group.q)
    if not here > usual:
        return
    maps = signs_and_exchanges(robot.dof)
    found = [
        (left, joint_causes(maps, number, robot)[0])
        for number, left in enumerate(_errors(robot, group, maps.of(group.q)))
        if left <= min(usual, COLLAPSED * here)
    ]
    if found:
        left, cause = min(found, key=lambda one: one[0])
        yield Diagnostic(
            kind="setup_fault",
            severity="implausible",
            sentence=f"{cause.clause[:1].upper()}{cause.clause[1:]}: with this set right, the errors of the robot as "
            f"drawn fall from {length_text(here)} to {length_text(left)} RMS; {cause.advice}.",
        )


def _errors(robot: Robot, rows: Measurements, q: Float64[Tensor, "maps rows dof"]) -> list[float]:
    """Root mean squares of the position errors [m] with base and tool fitted, as if nothing were fitted."""
    measured = MeasuredPoses.of(rows.position, None, 0.0)
    errors = []
    for T in forward_kinematics(robot, q):
        base, tool = best_base_and_tool(T, measured)
        square = measured.squares(base @ T @ tool).mean()
        errors.append(float((square * 3 * rows.rows / (3 * rows.rows - FITTED)).sqrt()))
    return errors

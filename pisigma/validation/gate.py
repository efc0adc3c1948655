"""Check of rows before they are used: every command that reads rows calls `check_rows`."""

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
from pisigma.validation.setup_faults.hypothesis import COLLAPSED
from pisigma.validation.setup_faults.joint_faults import joint_causes, signs_and_exchanges
from pisigma.validation.setup_faults.nominal_robot_faults import MIN_ROWS_NOMINAL, largest_group, usual_error
from pisigma.validation.setup_faults.setup_fault import SetupFault

MIN_ROWS_TO_CALIBRATE = 12
"""Rows from which a calibration shows whether the errors of the arm are too large for this robot."""
MIN_ROWS = 4
"""With fewer rows, the positions may be near each other by chance."""
SCALE = 30.0
"""Spread of the measured over that of the nominal positions above which (or below whose inverse) the unit is wrong."""
ARM_SHARE = 0.3
"""Spread of positions caused by a tool that the nominal robot lacks, and smallest spread of usual poses, as a share of
the reach."""

MIN_ROWS_FOR_JOINTS = 8
"""Rows that distinguish columns of joints: 24 values, of which base and tool take 9."""


@dataclass(frozen=True, eq=False)
class RowVerdict:
    """Findings of the checks of rows.

    Attributes:
        diagnostics: the findings; those that make the rows implausible come first.
        judged: the rows with the predictions of the model; None if they were compared with a nominal robot, or if too
            few of them have positions.
        faults_of_lengths: setup faults that explain the errors of rows without positions.
    """

    diagnostics: tuple[Diagnostic, ...] = ()
    judged: RowsUnderModel | None = None
    faults_of_lengths: tuple[SetupFault, ...] = ()

    @property
    def setup_faults(self) -> tuple[SetupFault, ...]:
        """Setup faults that explain the errors of all rows, of any size, including allowed motions."""
        return self.faults_of_lengths if self.judged is None else self.judged.setup_faults

    @property
    def implausible(self) -> tuple[Diagnostic, ...]:
        """Findings because of which the rows must not be used; commands exit with status 3."""
        return tuple(one for one in self.diagnostics if one.severity == "implausible")

    @property
    def trusted(self) -> bool:
        """Whether the rows may be used."""
        return not self.implausible


def check_rows(
    rows: Measurements,
    against: Robot | CalibratedModel,
    fitted: Collection[FrameKind] = (),
    may_move: Collection[Move] = (),
    nominal: CalibratedModel | None = None,
) -> RowVerdict:
    """Check rows before they are used.

    Against a model, the checks of `ROW_CHECKS` are run, or those of `diagnosed_lengths` for rows without positions.
    Against a nominal robot, or the mean robot of a fleet, the spread of the positions is compared with that of the
    robot's poses; with at least 6 rows other robots of the catalogue are tried, with 8 signs and exchanges of joint
    columns, with 12 the rows are used for a calibration that is checked by `CHECKS`, and with 24 for setup faults.

    Args:
        rows: the rows.
        against: a calibrated model, or the nominal robot.
        fitted: what is known to have moved since the model was made.
        may_move: what else may have moved since, without being a fault of the rows.
        nominal: the nominal robot with base and tool fitted; only used to report its errors after a correction.

    Raises:
        MeasurementError: the model does not have a frame or a target of the rows.
        PoseError: the joint values do not fit the robot.
    """
    if isinstance(against, CalibratedModel) and against.kind == FLEET_PRIOR and against.nominal is not None:
        against = against.nominal
    if isinstance(against, Robot):
        return RowVerdict(_until_implausible(_against_robot(rows, against)))
    judged = RowsUnderModel.from_rows(against, rows, fitted, may_move, nominal)
    if judged is None and rows.position is None:
        diagnostics, faults = diagnosed_lengths(against, rows, fitted, may_move)
        return RowVerdict(diagnostics, None, faults)
    if judged is None:
        return RowVerdict()
    return RowVerdict(_until_implausible(check.diagnose(judged) for check in ROW_CHECKS), judged)


def _until_implausible(checks: Iterable[Iterable[Diagnostic]]) -> tuple[Diagnostic, ...]:
    """Collect findings up to the first check that finds the rows implausible; later ones are consequences."""
    found: list[Diagnostic] = []
    for diagnostics in checks:
        found += diagnostics
        if any(one.severity == "implausible" for one in found):
            break
    return tuple(sorted(found, key=lambda one: one.severity != "implausible"))


def _against_robot(rows: Measurements, robot: Robot) -> Iterator[Iterable[Diagnostic]]:
    """Run the checks by the nominal robot, the most reliable first."""
    yield setup_diagnostics(robot, rows)
    yield size_of_positions(robot, rows)
    yield joint_columns(robot, rows)
    yield other_robot_diagnostics(robot, rows)
    if rows.rows >= MIN_ROWS_TO_CALIBRATE:
        yield _as_calibrated(rows, robot)


def _as_calibrated(rows: Measurements, robot: Robot) -> tuple[Diagnostic, ...]:
    """Check a calibration of the rows."""
    try:
        return diagnostics_of_rows(GeometricCalibrator(robot), rows)
    except IdentificationError as refusal:  # no calibration error explains the rows
        sentence = str(refusal).removeprefix(f"{rows.source}: ")
        return (Diagnostic(kind="implausible_errors", severity="implausible", sentence=sentence),)


def size_of_positions(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Compare the spread of the measured positions with that of the nominal robot's."""
    group = largest_group(rows)
    if group.position is None or group.rows < MIN_ROWS:
        return
    measured, nominal = (
        position_spread(group.position),
        position_spread(forward_kinematics(robot, group.q)[:, :3, 3]),
    )
    arm = ARM_SHARE * robot.reach
    if measured > SCALE * (nominal + arm):
        cause, mistake = "mm_named_m", "x, y and z are millimetres that are named metres"
    elif SCALE * measured < nominal > arm:
        cause = "m_named_mm"
        mistake = "x, y and z are metres that are named millimetres, or do not change with the robot"
    else:
        return
    yield Diagnostic(
        kind="setup_fault",
        severity="implausible",
        sentence=f"The measured positions are {measured * 1e3:,.1f} mm RMS from their mean, but those of robot "
        f"'{robot.name}' at these joint values are {nominal * 1e3:,.1f} mm: {mistake}; check the column names and the "
        "instrument.",
        cause=cause,
        values={"measured_mm": measured * 1e3, "nominal_mm": nominal * 1e3},
    )


def joint_columns(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Try a reversed sign of every joint and an exchange of two neighbours, with base and tool fitted each time.

    With at least `MIN_ROWS_NOMINAL` rows, `find_nominal_robot_faults` tries many more hypotheses instead.
    """
    group = largest_group(rows)
    if not MIN_ROWS_FOR_JOINTS <= group.rows < MIN_ROWS_NOMINAL:
        return
    here, usual = _errors(robot, group, group.q[None])[0], usual_error(robot, group.q)
    if not here > usual:
        return
    maps = signs_and_exchanges(robot.dof)
    found = [
        (left, joint_causes(maps, number, robot)[0])
        for number, left in enumerate(_errors(robot, group, maps.apply(group.q)))
        if left <= min(usual, COLLAPSED * here)
    ]
    if found:
        left, cause = min(found, key=lambda one: one[0])
        yield Diagnostic(
            kind="setup_fault",
            severity="implausible",
            sentence=f"{cause.clause[:1].upper()}{cause.clause[1:]}: with this corrected, the errors of the nominal "
            f"robot fall from {length_text(here)} to {length_text(left)} RMS; {cause.advice}.",
            cause=cause.kind,
            values={"joints": tuple(joint + 1 for joint in cause.joints)},
        )


def _errors(robot: Robot, rows: Measurements, q: Float64[Tensor, "maps rows dof"]) -> list[float]:
    """Compute RMS position errors [m] with base and tool fitted, corrected for the degrees of freedom."""
    measured = MeasuredPoses.from_tensors(rows.position, None, 0.0)
    errors = []
    for T in forward_kinematics(robot, q):
        base, tool = best_base_and_tool(T, measured)
        square = measured.squares(base @ T @ tool).mean()
        errors.append(float((square * 3 * rows.rows / (3 * rows.rows - FITTED)).sqrt()))
    return errors

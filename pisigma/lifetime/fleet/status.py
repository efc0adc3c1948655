"""Status of a fleet: robots that have the largest errors, drift, are overdue, were refused or are missing."""

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pisigma.lifetime.fleet.record import RobotRecord, SessionRecord
from pisigma.measurement.dates import EXPECTED_DATE, is_date


@dataclass(frozen=True)
class RobotStatus:
    """Status of a robot.

    Attributes:
        robot: id of the robot.
        last: last session that was not refused; None if there is none.
        refused: session that was refused; None if none was.
        days: days since the last session; None if that has no date.
        overdue: whether that is too long.
        compared: whether the last session was compared with an earlier one, or there is no earlier one.
    """

    robot: str
    last: SessionRecord | None
    refused: SessionRecord | None
    days: int | None = None
    overdue: bool = False
    compared: bool = True

    @property
    def is_drifting(self) -> bool:
        """Whether something moved since the session before, or a recalibration is recommended."""
        last = self.last
        return last is not None and (last.recalibrate or last.moved or last.verdict in ("moved", "unclear"))

    @property
    def state(self) -> str:
        """The first that applies of: refused, missing (not processed yet), drifting, overdue, fine."""
        if self.refused is not None:
            return "refused"
        if self.last is None:
            return "missing"
        return "drifting" if self.is_drifting else "overdue" if self.overdue else "fine"


@dataclass(frozen=True)
class FleetStatus:
    """Status of a fleet.

    Attributes:
        robots: status of each robot, sorted by id.
        today: date of the status.
        overdue_days: days without a session after which a robot is overdue.
        warnings: warnings on sessions with impossible dates, which are ignored.
    """

    robots: tuple[RobotStatus, ...]
    today: datetime.date
    overdue_days: int
    warnings: tuple[str, ...] = ()

    @staticmethod
    def from_records(
        records: Sequence[RobotRecord], today: datetime.date, overdue_days: int, expected: Sequence[str] = ()
    ) -> "FleetStatus":
        """Compute the status of a fleet.

        Args:
            records: records of the robots.
            today: date of the status.
            overdue_days: days without a session after which a robot is overdue.
            expected: ids of all robots; those without a record are missing.
        """
        robots = [_status(one, today, overdue_days) for one in records]
        missing = set(expected) - {one.robot for one in records}
        robots += [RobotStatus(robot, None, None) for robot in missing]
        warnings = tuple(
            f"robot {record.robot}: expected {EXPECTED_DATE} as the date of session {one.session}, got {one.date}; "
            "correct it in the manifest and run the fleet again."
            for record in records
            for one in record.sessions
            if one.date and not is_date(one.date)
        )
        return FleetStatus(tuple(sorted(robots, key=lambda one: one.robot)), today, overdue_days, warnings)

    @property
    def robots_by_error(self) -> tuple[RobotStatus, ...]:
        """Robots with known errors, the largest first."""
        judged = [one for one in self.robots if one.last is not None and one.last.error_mm is not None]
        return tuple(sorted(judged, key=lambda one: -_rms(one)))

    @property
    def action(self) -> bool:
        """Whether a robot was refused, is missing or drifts."""
        return any(one.state in ("refused", "missing", "drifting") for one in self.robots)

    def robots_in_state(self, state: str) -> tuple[RobotStatus, ...]:
        """Return the robots in a state."""
        return tuple(one for one in self.robots if one.state == state)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain values."""
        return {
            "robots": len(self.robots),
            "today": self.today.isoformat(),
            "worst": [{"robot": one.robot, "rms_mm": _rms(one)} for one in self.robots_by_error],
            "drifting": [one.robot for one in self.robots if one.is_drifting],
            "overdue": [{"robot": one.robot, "days": one.days} for one in self.robots if one.overdue],
            "not_compared": [one.robot for one in self.robots if not one.compared],
            "missing": [one.robot for one in self.robots_in_state("missing")],
            "refused": [
                {"robot": one.robot, "reason": one.refused.sentence}
                for one in self.robots
                if one.refused is not None
            ],
            "warnings": list(self.warnings),
        }


def _rms(one: RobotStatus) -> float:
    assert one.last is not None
    return one.last.error_mm or 0.0


def _status(record: RobotRecord, today: datetime.date, overdue_days: int) -> RobotStatus:
    """Compute the status of one robot."""
    done = [one for one in record.sessions if not one.refused]
    last = done[-1] if done else None
    date = last.date if last is not None and is_date(last.date) else None
    days = None if date is None else (today - datetime.date.fromisoformat(date)).days
    return RobotStatus(
        robot=record.robot,
        last=last,
        refused=next((one for one in record.sessions if one.refused), None),
        days=days,
        overdue=days is not None and days > overdue_days,
        compared=len(done) < 2 or done[-1].verdict != "calibrated",
    )

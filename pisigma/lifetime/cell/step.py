"""The next step of a cell: its state, the reason and the command."""

from dataclasses import dataclass
from typing import Any, Literal

COMPUTED = ("calibrate", "verify", "monitor", "recalibrate")
"""Commands that need neither new rows nor a decision by a person."""

State = Literal[
    "several_arms",
    "model_changed",
    "edited_session",
    "not_taken_in",
    "file_refused",
    "no_plan",
    "not_measured",
    "session_incomplete",
    "not_calibrated",
    "settings_changed",
    "not_trusted",
    "not_verified",
    "verification_failed",
    "other_joint_zeros",
    "session_not_judged",
    "session_not_trusted",
    "moved",
    "older_than_evidence",
    "outside_limit",
    "limit_below_scatter",
    "better_model",
    "fitted_to_set_aside",
    "fitted_before_event",
    "verification_due",
    "up_to_date",
]

ATTENTION: tuple[State, ...] = (
    "model_changed",
    "edited_session",
    "file_refused",
    "not_trusted",
    "session_not_trusted",
    "verification_failed",
    "moved",
    "other_joint_zeros",
    "fitted_to_set_aside",
    "fitted_before_event",
    "outside_limit",
    "limit_below_scatter",
)
"""States in which a limit is missed, or rows or a model must not be trusted."""


@dataclass(frozen=True)
class Step:
    """The next step of a cell.

    Attributes:
        state: state of the cell.
        reason: reason why the step is due, in one sentence without its full stop.
        command: command to run; empty if no step is due.
    """

    state: State
    reason: str
    command: str = ""

    def __post_init__(self) -> None:
        """Remove the full stop of a reason that is the summary of a check."""
        object.__setattr__(self, "reason", self.reason.rstrip("."))

    @property
    def automatic_command(self) -> str | None:
        """Name of the command if it needs neither rows nor a decision by a person; otherwise None."""
        words = self.command.split()[1:2]
        return words[0] if words and words[0] in COMPUTED else None

    def to_json(self) -> dict[str, Any]:
        """Return the step as plain values."""
        return {"state": self.state, "reason": self.reason, "command": self.command or None}

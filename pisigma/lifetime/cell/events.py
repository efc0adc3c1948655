"""Events of a cell: changes of its robot, tool or instrument, and acceptances of models."""

from dataclasses import dataclass
from typing import Literal, get_args

from pisigma.files.errors import MeasurementError, check_choice
from pisigma.measurement.dates import EXPECTED_DATE, is_date

EventKind = Literal[
    "instrument", "tool", "mastering", "encoder", "collision", "maintenance", "firmware", "accepted"
]
"""Kind of event: the instrument (tracker, camera, board) was set up again, the tool or reflector was replaced, or the
arm was changed (see `ARM_EVENTS`). "firmware" and "accepted" (by a person) are only recorded."""
ARM_EVENTS: frozenset[EventKind] = frozenset(("mastering", "encoder", "collision", "maintenance"))
"""Events after which earlier sessions no longer describe the arm."""
CHANGING_EVENTS: frozenset[EventKind] = ARM_EVENTS | {"instrument", "tool"}
"""Events after which rows must not be fitted together with earlier rows as if nothing had changed."""


@dataclass(frozen=True)
class Event:
    """A change of the robot, its tool or its instrument, or the acceptance of a model by a person.

    Attributes:
        day: day of the event (ISO 8601); sessions of that day were measured after the event.
        kind: kind of event: "instrument", "tool", "mastering", "encoder", "collision", "maintenance", "firmware" or
            "accepted".
        note: free text.
        recorded: time of recording (ISO 8601, UTC).
        person: person who accepted the model or reported the change; empty if not stated.
        model: name of the accepted model; empty for all other kinds of events.
    """

    day: str
    kind: EventKind
    note: str
    recorded: str
    person: str = ""
    model: str = ""

    @property
    def sentence(self) -> str:
        """Day, kind, person and note as one line."""
        what = f"model '{self.model}' was accepted" if self.kind == "accepted" else self.kind
        by, note = f" by {self.person}" if self.person else "", f" ({self.note})" if self.note else ""
        return f"{self.day}: {what}{by}{note}."

    def to_json(self) -> dict[str, str]:
        """Return the event as plain values, without the time of recording."""
        names = ("day", "kind", "note", "person", "model")
        return {name: getattr(self, name) for name in names}


def check_event(kind: str, day: str, person: str) -> None:
    """Refuse an event of an unknown kind or with an invalid date, or an acceptance without a person.

    Args:
        kind: kind of the event.
        day: day of the event (ISO 8601).
        person: person who accepted the model or reported the change.

    Raises:
        MeasurementError: the kind is unknown, the day is not a valid date, or the person who accepted is not named.
    """
    check_choice(MeasurementError, "event", kind, get_args(EventKind))
    if not is_date(day):
        raise MeasurementError(expected=EXPECTED_DATE, value=day, option="--date")
    if kind == "accepted" and not person.strip():
        raise MeasurementError(expected="the name of the person who accepted", value=person, option="--by")

"""Setup faults that explain large errors, in the form that is reported."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pisigma.validation.held_out.diagnostic import Diagnostic, Severity
from pisigma.validation.setup_faults.cause import Cause, length_text
from pisigma.validation.setup_faults.hypothesis import COLLAPSED, Hypothesis


@dataclass(frozen=True)
class SetupFault:
    """A setup fault that explains errors, which fall to a quarter or less when it is corrected.

    Attributes:
        kinds: kinds of the causes, see `Cause.kind`.
        clause: what is wrong, such as "the sign of joint 3 is reversed".
        advice: what to check.
        before: root mean square of the position errors [m].
        after: root mean square of the position errors after correction of the fault [m].
        after_nominal: root mean square of the nominal robot's errors after correction of the fault [m]; NaN if the
            fault concerns the joint correction.
        before_rotation: root mean square of the rotation errors [rad]; NaN if none was measured.
        after_rotation: root mean square of the rotation errors after correction of the fault [rad].
        moved: largest motion of a joint zero [rad or m]; infinite for faults of other kinds.
        joints: indices of the joints concerned, from 0.
        amounts: amount of every cause, see `Cause.amount`.
        columns: columns with the values of every joint, see `Cause.columns`.
    """

    kinds: tuple[str, ...]
    clause: str
    advice: str
    before: float
    after: float
    after_nominal: float
    before_rotation: float
    after_rotation: float
    moved: float = math.inf
    joints: tuple[int, ...] = ()
    amounts: tuple[float, ...] = ()
    columns: tuple[int, ...] = ()

    @property
    def explains_orientation(self) -> bool:
        """Whether the fault also explains the rotation errors."""
        return self.after_rotation <= COLLAPSED * self.before_rotation

    @property
    def sentence(self) -> str:
        """Sentence about what is wrong, the errors after its correction, and what to check."""
        clause = self.clause[:1].upper() + self.clause[1:]
        if not np.isfinite(self.after):
            return f"{clause}; {self.advice}."
        fall = f"from {length_text(self.before)} to {length_text(self.after)} RMS"
        if np.isfinite(self.before_rotation):
            degrees = np.rad2deg([self.before_rotation, self.after_rotation])
            fall += f" and from {degrees[0]:.3g} deg to {degrees[1]:.3g} deg"
        if np.isfinite(self.after_nominal):
            fall += f" (those of the nominal robot to {length_text(self.after_nominal)})"
        return f"{clause}: with this corrected, the errors fall {fall}; {self.advice}."

    def diagnostic(self, severity: Severity = "implausible") -> Diagnostic:
        """Return the fault as a finding of the checks."""
        return Diagnostic(
            kind="setup_fault",
            severity=severity,
            sentence=self.sentence,
            cause=self.cause,
            values=self.values,
            remedy=self.advice,
        )

    @property
    def cause(self) -> str:
        """Kinds of the causes in one word, such as "joint_sign" or "frame+tool"; see `Diagnostic.cause`."""
        return "+".join(self.kinds)

    @property
    def values(self) -> dict[str, float | int | str | tuple[int, ...]]:
        """Numbers in the sentence, by name, with joints counted from 1; see `Diagnostic.values`."""
        figures = {"before_mm": self.before * 1e3, "after_mm": self.after * 1e3}
        finite = {name: value for name, value in figures.items() if np.isfinite(value)}
        if len(self.amounts) == 1 and self.kinds[0].endswith("_unit") and np.isfinite(self.amounts[0]):
            finite["ratio"] = self.amounts[0]
        columns = {"columns": self.columns} if self.columns else {}
        return {**finite, "joints": tuple(joint + 1 for joint in self.joints), **columns}

    def to_json(self) -> dict[str, object]:
        """Return kinds, sentence and errors in mm and, if measured, in deg."""
        figures = {
            "before_rms_mm": self.before * 1e3,
            "after_rms_mm": self.after * 1e3,
            "after_nominal_rms_mm": self.after_nominal * 1e3,
            "before_rms_deg": float(np.rad2deg(self.before_rotation)),
            "after_rms_deg": float(np.rad2deg(self.after_rotation)),
        }
        measured = {name: value for name, value in figures.items() if np.isfinite(value)}
        return {"kinds": list(self.kinds), "sentence": self.sentence, **measured}


def combine_alternatives(faults: Sequence[SetupFault]) -> SetupFault:
    """Combine faults that explain the errors about equally well, best first, to one fault with alternatives."""
    if len(faults) == 1:
        return faults[0]
    clauses = dict.fromkeys(fault.clause for fault in faults)
    advice = dict.fromkeys(fault.advice for fault in faults)
    moved = max(fault.moved for fault in faults)
    clause, advised = ", or ".join(clauses), "; ".join(advice)
    return replace(faults[0], clause=clause, advice=advised, moved=moved, amounts=(), columns=())


def fault_of_cause(cause: Cause, before: float, after: float) -> SetupFault:
    """Return the fault of a single cause, with the RMS position errors before and after its correction [m]."""
    nan = math.nan
    return SetupFault(
        *((cause.kind,), cause.clause, cause.advice, before, after, nan, nan, nan),
        joints=cause.joints,
        columns=cause.columns,
    )


def fault_from_hypothesis(as_stated: Hypothesis, other: Hypothesis, after_nominal: float) -> SetupFault:
    """Return the fault of a hypothesis, with errors before (`as_stated`) and after, and of the nominal robot [m]."""
    (before, before_rotation), (after, after_rotation) = as_stated.rms(), other.rms()
    return SetupFault(
        kinds=tuple(cause.kind for cause in other.causes),
        clause=" and ".join(cause.clause for cause in other.causes),
        advice="; ".join(cause.advice for cause in other.causes),
        before=before,
        after=after,
        after_nominal=after_nominal,
        before_rotation=before_rotation,
        after_rotation=after_rotation,
        moved=max(cause.moved for cause in other.causes),
        joints=tuple(joint for cause in other.causes for joint in cause.joints),
        amounts=tuple(cause.amount for cause in other.causes),
        columns=next((cause.columns for cause in other.causes if cause.columns), ()),
    )

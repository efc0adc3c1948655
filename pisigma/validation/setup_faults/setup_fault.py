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
        rms_before: root mean square of the position errors [m].
        rms_after: root mean square of the position errors after correction of the fault [m].
        nominal_rms_after: root mean square of the nominal robot's errors after correction of the fault [m]; NaN if the
            fault concerns the joint correction.
        rotation_rms_before: root mean square of the rotation errors [rad]; NaN if none was measured.
        rotation_rms_after: root mean square of the rotation errors after correction of the fault [rad].
        largest_zero_shift: largest motion of a joint zero [rad or m]; infinite for faults of other kinds.
        joints: indices of the joints concerned, from 0.
        cause_amounts: amount of every cause, see `Cause.amount`.
        signed_column_of_joint: columns with the values of every joint, see `Cause.signed_column_of_joint`.
    """

    kinds: tuple[str, ...]
    clause: str
    advice: str
    rms_before: float
    rms_after: float
    nominal_rms_after: float
    rotation_rms_before: float
    rotation_rms_after: float
    largest_zero_shift: float = math.inf
    joints: tuple[int, ...] = ()
    cause_amounts: tuple[float, ...] = ()
    signed_column_of_joint: tuple[int, ...] = ()

    @property
    def explains_orientation(self) -> bool:
        """Whether the fault also explains the rotation errors."""
        return self.rotation_rms_after <= COLLAPSED * self.rotation_rms_before

    @property
    def sentence(self) -> str:
        """Sentence about what is wrong, the errors after its correction, and what to check."""
        clause = self.clause[:1].upper() + self.clause[1:]
        if not np.isfinite(self.rms_after):
            return f"{clause}; {self.advice}."
        fall = f"from {length_text(self.rms_before)} to {length_text(self.rms_after)} RMS"
        if np.isfinite(self.rotation_rms_before):
            degrees = np.rad2deg([self.rotation_rms_before, self.rotation_rms_after])
            fall += f" and from {degrees[0]:.3g} deg to {degrees[1]:.3g} deg"
        if np.isfinite(self.nominal_rms_after):
            fall += f" (those of the nominal robot to {length_text(self.nominal_rms_after)})"
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
        figures = {"before_mm": self.rms_before * 1e3, "after_mm": self.rms_after * 1e3}
        finite = {name: value for name, value in figures.items() if np.isfinite(value)}
        if (
            len(self.cause_amounts) == 1
            and self.kinds[0].endswith("_unit")
            and np.isfinite(self.cause_amounts[0])
        ):
            finite["ratio"] = self.cause_amounts[0]
        columns = {"columns": self.signed_column_of_joint} if self.signed_column_of_joint else {}
        return {**finite, "joints": tuple(joint + 1 for joint in self.joints), **columns}

    def to_json(self) -> dict[str, object]:
        """Return kinds, sentence and errors in mm and, if measured, in deg."""
        figures = {
            "before_rms_mm": self.rms_before * 1e3,
            "after_rms_mm": self.rms_after * 1e3,
            "after_nominal_rms_mm": self.nominal_rms_after * 1e3,
            "before_rms_deg": float(np.rad2deg(self.rotation_rms_before)),
            "after_rms_deg": float(np.rad2deg(self.rotation_rms_after)),
        }
        measured = {name: value for name, value in figures.items() if np.isfinite(value)}
        return {"kinds": list(self.kinds), "sentence": self.sentence, **measured}


def combine_alternatives(faults: Sequence[SetupFault]) -> SetupFault:
    """Combine faults that explain the errors about equally well, best first, to one fault with alternatives."""
    if len(faults) == 1:
        return faults[0]
    clauses = dict.fromkeys(fault.clause for fault in faults)
    advice = dict.fromkeys(fault.advice for fault in faults)
    moved = max(fault.largest_zero_shift for fault in faults)
    clause, advised = ", or ".join(clauses), "; ".join(advice)
    return replace(
        faults[0],
        clause=clause,
        advice=advised,
        largest_zero_shift=moved,
        cause_amounts=(),
        signed_column_of_joint=(),
    )


def fault_of_cause(cause: Cause, rms_before: float, rms_after: float) -> SetupFault:
    """Return the fault of a single cause, with the RMS position errors before and after its correction [m]."""
    nan = math.nan
    return SetupFault(
        *((cause.kind,), cause.clause, cause.advice, rms_before, rms_after, nan, nan, nan),
        joints=cause.joints,
        signed_column_of_joint=cause.signed_column_of_joint,
    )


def fault_from_hypothesis(as_stated: Hypothesis, other: Hypothesis, nominal_rms_after: float) -> SetupFault:
    """Return the fault of a hypothesis, with errors before (`as_stated`) and after, and of the nominal robot [m]."""
    (before, before_rotation), (after, after_rotation) = as_stated.rms(), other.rms()
    return SetupFault(
        kinds=tuple(cause.kind for cause in other.causes),
        clause=" and ".join(cause.clause for cause in other.causes),
        advice="; ".join(cause.advice for cause in other.causes),
        rms_before=before,
        rms_after=after,
        nominal_rms_after=nominal_rms_after,
        rotation_rms_before=before_rotation,
        rotation_rms_after=after_rotation,
        largest_zero_shift=max(cause.largest_zero_shift for cause in other.causes),
        joints=tuple(joint for cause in other.causes for joint in cause.joints),
        cause_amounts=tuple(cause.amount for cause in other.causes),
        signed_column_of_joint=next(
            (cause.signed_column_of_joint for cause in other.causes if cause.signed_column_of_joint), ()
        ),
    )

"""Causes of errors: what may be wrong with a setup or a file."""

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """A fault of the setup or the file.

    Attributes:
        kind: "frame", "tool", "target", "position_unit", "rotation", "handedness", "rows", "joint_unit", "joint_order",
            "joint_sign", "joint_coupling", "joint_zero", "joint_values" or "correction".
        clause: what is wrong, such as "the sign of joint 3 is reversed".
        advice: what the fault means or what to check.
        complexity: complexity of the assumption, at least 1; among equally good explanations, the simplest is chosen.
        joints: indices of the joints concerned, from 0.
        largest_zero_shift: largest displacement of a joint zero [rad or m]; infinite for faults of other kinds.
        amount: displacement of a frame or tool [m]; for a wrong unit, the ratio of correct to stated values; the number
            of corrections applied in addition to those logged (1 or -1); or the number of targets with the same name.
            NaN for faults of other kinds.
        signed_column_of_joint: for every joint, the number (from 1) of the logged column with its values, negative for
            a reversed sign; empty for faults other than "joint_order" and "joint_sign".
    """

    kind: str
    clause: str
    advice: str
    complexity: float
    joints: tuple[int, ...] = ()
    largest_zero_shift: float = math.inf
    amount: float = math.nan
    signed_column_of_joint: tuple[int, ...] = ()


def joints_text(joints: tuple[int, ...]) -> str:
    """Return a text with the joint numbers (from 1) of joint indices (from 0)."""
    if len(joints) == 1:
        return f"joint {joints[0] + 1}"
    if len(joints) > 2 and joints[-1] - joints[0] == len(joints) - 1:
        return f"joints {joints[0] + 1} to {joints[-1] + 1}"
    return f"joints {join_words(str(i + 1) for i in joints)}"


def join_words(words: Iterable[str]) -> str:
    """Join words to a list for a sentence."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def length_text(length: float) -> str:
    """Format a length [m] in millimetres, with three significant digits or all integer digits."""
    return f"{length * 1e3:.3g} mm" if abs(length) < 1 else f"{length * 1e3:,.0f} mm"

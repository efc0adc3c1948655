"""What may be wrong with a setup, as one clause."""

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """One thing that is wrong with the setup.

    Attributes:
        kind: "frame", "tool", "target", "position_unit", "rotation", "handedness", "rows", "joint_unit", "joint_order",
            "joint_sign", "joint_coupling", "joint_zero", "joint_values" or "correction".
        clause: what is wrong, such as "the sign of joint 3 is reversed".
        advice: what it means or what to check.
        size: how much is assumed, 1 at least; of what explains equally well, the smallest is believed.
        joints: the joints that it is about, from 0.
        moved: how far the zeros of joints have moved at most [rad or m]; infinite where it is about something else.
    """

    kind: str
    clause: str
    advice: str
    size: float
    joints: tuple[int, ...] = ()
    moved: float = math.inf


def joints_text(joints: tuple[int, ...]) -> str:
    """Write the numbers of joints, which are counted from 0, as people count them."""
    if len(joints) == 1:
        return f"joint {joints[0] + 1}"
    if len(joints) > 2 and joints[-1] - joints[0] == len(joints) - 1:
        return f"joints {joints[0] + 1} to {joints[-1] + 1}"
    return f"joints {joined(str(i + 1) for i in joints)}"


def joined(words: Iterable[str]) -> str:
    """Join words as a list in a sentence."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def length_text(length: float) -> str:
    """Write a length [m] in millimetres, with three digits or all whole ones."""
    return f"{length * 1e3:.3g} mm" if abs(length) < 1 else f"{length * 1e3:,.0f} mm"

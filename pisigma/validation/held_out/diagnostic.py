"""Findings of the checks: why a calibration or rows must not be trusted, and warnings."""

from typing import Literal

from pydantic import Field

from pisigma.files.yaml_file import Section

Severity = Literal["implausible", "warning"]
"""Whether the result must not be trusted ("implausible"), or should be checked ("warning")."""


class Diagnostic(Section):
    """One finding of a check of a calibration or of rows.

    Attributes:
        kind: kind of the finding, such as "search" or "prior_ratio"; one check may report several kinds.
        severity: "implausible": the result must not be trusted, and commands end with status 3; or "warning".
        sentence: what is wrong, where, and what to do.
        rows: places (file and line) of the rows at fault; empty if all rows are concerned.
        cause: what was found, among the findings of this kind, such as "frame" or "tool" of "row_order"; may be empty.
        values: numbers and names of the sentence by name; the unit ends the name ("shift_mm"). Joints count from 1.
            "log_odds" is the logarithm of the odds of the finding, "sigma" the standard deviation of its amount.
        remedy: what to do, as at the end of the sentence; empty if the sentence says only what to check.
    """

    kind: str
    severity: Severity
    sentence: str
    rows: tuple[str, ...] = ()
    cause: str = ""
    values: dict[str, float | int | str | tuple[int, ...]] = Field(default_factory=dict)
    remedy: str = ""

"""Findings of the checks: warnings, and reasons not to trust a calibration or rows."""

from typing import Annotated, Literal

from pydantic import Field

from pisigma.files.yaml_file import StoredFigures

Severity = Literal["implausible", "warning"]
"""Whether the result must not be trusted ("implausible") or should be checked ("warning")."""


class Diagnostic(StoredFigures):
    """One finding of a check of a calibration or of rows.

    Attributes:
        kind: kind of the finding, such as "search" or "prior_ratio"; one check may report several kinds.
        severity: "implausible": the result must not be trusted, and commands end with status 3; or "warning".
        sentence: what is wrong, where, and what to do.
        row_places: file and line of each row at fault; empty if all rows are concerned.
        cause: what was found, within the kind, such as "frame" or "tool" for "row_order"; may be empty.
        values: numbers and names in the sentence, by name; names end with the unit ("shift_mm"). Joints are counted
            from 1. "log_odds" is the logarithm of the odds of the finding, and "sigma" the standard deviation of its
            amount.
        remedy: what to do, as at the end of the sentence; empty if the sentence only says what to check.
    """

    kind: str
    severity: Severity
    sentence: str
    row_places: Annotated[tuple[str, ...], Field(alias="rows")] = ()
    cause: str = ""
    values: dict[str, float | int | str | tuple[int, ...]] = Field(default_factory=dict)
    remedy: str = ""

"""What is wrong with a calibration, or should be heeded."""

from typing import Literal

from pisigma.files.yaml_file import Section

Severity = Literal["implausible", "warning"]
"""Whether the calibration must not be trusted, or only something should be heeded."""


class Diagnostic(Section):
    """One thing that a check says of a calibration.

    Attributes:
        kind: such as "search" or "prior_ratio"; one check may have several.
        severity: "implausible": the calibration must not be trusted, commands end with status 3; or "warning".
        sentence: what is wrong, where, and what to do.
        rows: places of the rows that it is about, file and line; none where it is about all of them.
    """

    kind: str
    severity: Severity
    sentence: str
    rows: tuple[str, ...] = ()

"""Rows that were left out because they contradict the others."""

from pisigma.files.yaml_file import Section


class ContradictingRowFigures(Section):
    """A row that was left out because it contradicts the others.

    Attributes:
        row: index in the measurements, from 0.
        place: file and line.
        residual_mm: length of its error under the model from the other rows [mm].
        residual_deg: angle of its orientation error [deg].
    """

    row: int
    place: str
    residual_mm: float | None = None
    residual_deg: float | None = None

    @property
    def sentence(self) -> str:
        """Sentence on which row was left out, why, and what to do."""
        sizes = ((self.residual_mm, "mm"), (self.residual_deg, "deg"))
        missed = " and ".join(f"{size:.3g} {unit}" for size, unit in sizes if size is not None)
        return (
            f"{self.place} was left out: it deviates by {missed} from its prediction by the others; "
            "measure it again."
        )

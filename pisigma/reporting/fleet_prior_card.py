"""The card of a fleet prior."""

from pathlib import Path

from pisigma.lifetime.fleet.prior_summary import FleetPriorSummary
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.rendering import write_card
from pisigma.reporting.tables import Table

UNDETERMINED = (
    "A parameter that the rows do not determine, such as where the first axis stands in the base, has mean 0 and the "
    "usual deviation of the robot's class."
)


def write_fleet_prior_card(model: CalibratedModel, summary: FleetPriorSummary, folder: Path) -> None:
    """Write the card into a model folder.

    Args:
        model: the mean robot.
        summary: its figures.
        folder: where to write.
    """
    write_card(
        folder,
        "fleet_prior_card.md.j2",
        model=model,
        summary=summary,
        parameters=common_table(summary),
        undetermined=UNDETERMINED,
        spectrum=spectrum_table(summary),
    )


def common_table(summary: FleetPriorSummary) -> Table:
    """Mean and standard deviation between robots of every geometric parameter."""
    rows = ((one.name, one.unit, f"{one.mean:z.4f}", f"{one.deviation:.4f}") for one in summary.parameters)
    return Table(("parameter", "unit", "mean", "between robots"), tuple(rows))


def spectrum_table(summary: FleetPriorSummary) -> Table:
    """Standard deviation between robots of the weights of the joint correction, by group."""
    return Table(
        ("weights", "between robots [deg]"), tuple((one.group, f"{one.deg:.5f}") for one in summary.spectrum)
    )

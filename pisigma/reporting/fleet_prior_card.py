"""Card of a fleet prior."""

from pathlib import Path

from pisigma.lifetime.fleet.prior_summary import FleetPriorSummary
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.rendering import write_card
from pisigma.reporting.tables import Table

UNDETERMINED = (
    "A parameter that the rows do not determine, such as the position of the first axis in the base, has mean 0 and "
    "the usual standard deviation of the robot's class."
)


def write_fleet_prior_card(model: CalibratedModel, summary: FleetPriorSummary, folder: Path) -> None:
    """Write the card into a model folder.

    Args:
        model: mean robot.
        summary: figures of the prior.
        folder: model folder.
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
    """Make a table of the mean and the standard deviation between robots of every geometric parameter."""
    rows = ((one.name, one.unit, f"{one.mean:z.4f}", f"{one.deviation:.4f}") for one in summary.parameters)
    return Table(("parameter", "unit", "mean", "between robots"), tuple(rows))


def spectrum_table(summary: FleetPriorSummary) -> Table:
    """Make a table of the standard deviation between robots of the joint correction's weights, by group."""
    return Table(
        ("weights", "between robots [deg]"), tuple((one.group, f"{one.deg:.5f}") for one in summary.spectrum)
    )

"""A fleet as one page that loads nothing from elsewhere, with filters by state and name."""

from markupsafe import Markup

from pisigma.lifetime.fleet.status import FleetStatus
from pisigma.reporting.fleet_tables import STATES, WHOSE_ERRORS, not_compared, robot_table, state_table
from pisigma.reporting.page.page import resource
from pisigma.reporting.rendering import render


def fleet_page(status: FleetStatus, name: str) -> str:
    """Lay the robots of a fleet out as HTML; every text is shown as it is, whatever it holds.

    Args:
        status: of the fleet.
        name: of the fleet.
    """
    order = {one.robot: place for place, one in enumerate(status.worst_first)}
    robots = sorted(
        status.robots, key=lambda one: (STATES.index(one.state), order.get(one.robot, len(order)))
    )
    return render(
        "fleet.html.j2",
        name=name,
        status=status,
        states=state_table(status),
        robots=robots,
        table=robot_table(robots),
        notes=(WHOSE_ERRORS, *filter(None, [not_compared(status)]), *status.warnings),
        style=Markup(resource("style.css")),  # ours
    )

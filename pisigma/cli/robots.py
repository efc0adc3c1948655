"""`pisigma robots`: the catalogue."""

import json
from typing import Annotated

import typer


def robots(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List the robots that come with pisigma."""
    from pisigma.robot import catalogue, load_robot

    known = [load_robot(name) for name in catalogue()]
    if as_json:
        entries = [
            {
                "name": robot.name,
                "maker": robot.maker,
                "joints": [{"name": joint.name, "type": joint.type} for joint in robot.joints],
                "reach_mm": robot.reach * 1e3,
                "source": robot.source,
            }
            for robot in known
        ]
        typer.echo(json.dumps({"robots": entries}))
        return
    from pisigma.cli.output import print_table

    rows = [
        (robot.name, str(robot.dof), "".join(j.type[0].upper() for j in robot.joints), f"{robot.reach * 1e3:.0f}", robot.maker)
        for robot in known
    ]
    print_table("robots of the catalogue", ("name", "joints", "types", "reach [mm]", "maker"), rows)

"""`pisigma robots`: the catalogue."""

from pisigma.cli.arguments import AsJson
from pisigma.cli.output import print_json, print_table


def robots(as_json: AsJson = False) -> None:
    """List the robots that come with pisigma."""
    from pisigma.robot import Robot, catalogue

    known = [Robot.load(name) for name in catalogue()]
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
        print_json({"robots": entries})
        return
    rows = [
        (
            robot.name,
            str(robot.dof),
            "".join(joint.type[0].upper() for joint in robot.joints),
            f"{robot.reach * 1e3:.0f}",
            robot.maker,
        )
        for robot in known
    ]
    columns = ("name", "joints", "types", "reach [mm]", "maker")
    print_table("robots of the catalogue (R: revolute, P: prismatic joint)", columns, rows)

"""The calibrated geometry as URDF: the file that the robot was drawn in with other numbers, else a new one."""

import re

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import check_geometry, chosen_geometry
from pisigma.files.errors import OutputError
from pisigma.files.model_files import DRAWING
from pisigma.robot.description import Robot
from pisigma.robot.urdf_rows import URDF_SOURCE
from pisigma.robot.urdf_template import robot_into_urdf
from pisigma.robot.writing import robot_to_urdf

_SOURCE = re.compile(re.escape(URDF_SOURCE) + r".+, from link '(?P<base>.*)' to link '(?P<tip>.*)'")


def _check(request: ExportRequest) -> None:
    if request.tip is not None and request.like is None:
        raise OutputError("--tip names a link of the file that --like gives; give both or none.")
    check_geometry(request)


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    chosen = chosen_geometry(model, request.geometry)
    text = drawn_into(request, chosen.robot, model.robot, chosen.said) or robot_to_urdf(
        chosen.robot, chosen.said
    )
    facts = model_facts(model) | {"geometry": chosen.name}
    return Exported(text, facts, chosen.said, doubts=_doubts(request, model.robot, text))


def drawn_into(request: ExportRequest, robot: Robot, nominal: Robot, said: tuple[str, ...]) -> str | None:
    """A robot in the URDF file of --like, or else in the one that it was drawn in, which the model folder holds.

    Args:
        request: the model and the options.
        robot: with the geometry to write.
        nominal: the robot of the model, whose `source` names the links.
        said: sentences for the head of the file.

    Returns:
        The text; None where there is no such file.
    """
    drawn = _SOURCE.search(nominal.source)
    like = request.like or (request.model / DRAWING if nominal.urdf else None)
    if like is None:
        return None
    base, tip = drawn.group("base", "tip") if drawn else (None, None)
    return robot_into_urdf(robot, nominal, like, request.tip or tip, said, base)


def _doubts(request: ExportRequest, nominal: Robot, text: str) -> tuple[str, ...]:
    """What to say of the other content of the file."""
    if _SOURCE.search(nominal.source) and request.like is None and nominal.urdf is None:
        return (
            "The model was made before models kept the URDF file of their robot: with --like FILE its links, meshes, "
            "masses and limits stay; this file has placeholders.",
        )
    meshes = re.findall(r'<mesh\s[^>]*filename="([^":]+)"', text)
    lost = [name for name in meshes if not (request.out.parent / name).is_file()]
    if not lost:
        return ()
    return (
        f"{len(lost)} meshes that the file names by their path from it, such as {lost[0]}, are not there; put it where "
        "they are, or simulators that read meshes refuse it.",
    )


FORMAT = ExportFormat("urdf", "a URDF", (".urdf",), _write, frozenset(("like", "tip", "geometry")), _check)

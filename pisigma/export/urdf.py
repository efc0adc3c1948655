"""The calibrated geometry as URDF: a new file, or the one that the robot was drawn in with other origins."""

from pisigma.errors import OutputError
from pisigma.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.export.geometry import calibrated_geometry, remarks
from pisigma.robot.writing import robot_into_urdf, robot_to_urdf


def _check(request: ExportRequest) -> None:
    if request.tip is not None and request.like is None:
        raise OutputError("--tip names a link of the file that --like gives; give both or none.")


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    robot, said = calibrated_geometry(model), remarks(model)
    if request.like is None:
        text = robot_to_urdf(robot, said)
    else:
        text = robot_into_urdf(robot, model.robot, request.like, request.tip, said)
    return Exported(text, model_facts(model), said)


FORMAT = ExportFormat("urdf", "a URDF", (".urdf",), _write, frozenset(("like", "tip")), _check)

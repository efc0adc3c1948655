"""Configuration of a KUKA controller that receives joint corrections over RSI from `pisigma serve --rsi`.

The format is the ETHERNET configuration of KUKA.RobotSensorInterface 3 and 4: in every interpolation cycle the
controller sends the commanded joint values (`ASPos`) [deg] and a time stamp (`IPOC`), and expects corrections of the
joints (`AKorr`) [deg] with the same time stamp. The file was loaded by RSIPI 0.3.0, not by a controller.
"""

import ipaddress
from dataclasses import dataclass
from pathlib import Path

from lxml import etree

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import pose_remarks
from pisigma.deployment.export.programs.languages import COUNTING
from pisigma.files.errors import OutputError, Place
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.writing import comment_text

_SENDER = "pisigma"
"""Name of the sender in answers (`SENTYPE`)."""
AXES = tuple(f"A{number}" for number in range(1, 7))
_REMARKS = (
    "ASPos and AKorr are in degrees. AKorr are absolute corrections of the joint values that the controller computes "
    "with its nominal kinematics: RSI_ON(#ABSOLUTE). With #RELATIVE they would add up in every cycle.",
    "In the RSI context, connect the outputs 1 to 6 of ETHERNET to the inputs A1 to A6 of AXISCORR, set the limits of "
    "AXISCORR and AXISCORRMON to the largest correction that you accept, and Timeout of ETHERNET to 10 packets.",
    "Not tested on a controller: try it first at low speed, with small limits of AXISCORR, away from obstacles.",
)


@dataclass(frozen=True)
class RsiAddress:
    """Address and name of the sender in an ETHERNET configuration of RSI.

    Attributes:
        host: IP address at which packets are received.
        port: UDP port at which packets are received.
        sender: `SENTYPE` of answers.
    """

    host: str
    port: int
    sender: str

    @staticmethod
    def read(file: Path, option: str = "--rsi") -> "RsiAddress":
        """Read the file that an option names.

        Raises:
            OutputError: the file is not an RSI configuration.
        """
        try:
            settings = etree.parse(file).getroot().find("CONFIG")
            found = {entry.tag: (entry.text or "").strip() for entry in settings}
            host = str(ipaddress.IPv4Address(found["IP_NUMBER"]))
            return RsiAddress(host, _port(found["PORT"]), found["SENTYPE"])
        except (OSError, etree.XMLSyntaxError, LookupError, TypeError, ValueError):
            raise OutputError(
                "the file is not an RSI configuration",
                at=Place(file),
                option=option,
                remedy="make one with: pisigma export MODEL --format rsi --out FILE",
            ) from None


def _port(text: str) -> int:
    if not 0 < (port := int(text)) < 65536:
        raise ValueError(text)
    return port


EXAMPLE = RsiAddress("192.168.1.10", 49152, _SENDER)
"""Address in a file that was not made from another file."""
SET_ADDRESS = (
    f"IP_NUMBER and PORT ({EXAMPLE.host}:{EXAMPLE.port}) are examples: set them to the address at which the computer "
    "that runs `pisigma serve` receives the packets of the controller."
)


def check_six_axes(model: CalibratedModel) -> None:
    """Check that the joints of a robot are A1 to A6.

    Raises:
        OutputError: the robot does not have six revolute joints.
    """
    axes = model.robot.axes
    if len(axes) != len(AXES) or any(axis.type != "revolute" for axis in axes):
        raise OutputError(
            f"RSI requires a robot with six revolute joints; robot '{model.robot.name}' has {len(axes)} axes",
            expected="six revolute joints",
            value=model.robot.name,
            remedy="choose --format targets with a .csv file",
        )


def rsi_configuration(host: str, port: int, comments: tuple[str, ...] = ()) -> str:
    """Write the ETHERNET configuration; comments state units and the requirements of the RSI context."""
    root = etree.Element("ROOT")
    for sentence in (*comments, *_REMARKS):
        root.append(etree.Comment(comment_text(sentence)))
    settings = etree.SubElement(root, "CONFIG")
    values = {"IP_NUMBER": host, "PORT": str(port), "SENTYPE": _SENDER, "ONLYSEND": "FALSE"}
    for name, value in values.items():
        etree.SubElement(settings, name).text = value
    sent = etree.SubElement(etree.SubElement(root, "SEND"), "ELEMENTS")
    for tag, kind in (("DEF_ASPos", "DOUBLE"), ("DEF_Delay", "LONG")):
        etree.SubElement(sent, "ELEMENT", TAG=tag, TYPE=kind, INDX="INTERNAL")
    received = etree.SubElement(etree.SubElement(root, "RECEIVE"), "ELEMENTS")
    for number, axis in enumerate(AXES, 1):
        # After a missed answer, the last correction is kept (HOLDON), because 0 would be a jump.
        entry = {"TAG": f"AKorr.{axis}", "TYPE": "DOUBLE", "INDX": str(number), "HOLDON": "1"}
        etree.SubElement(received, "ELEMENT", entry)
    return str(etree.tostring(root, pretty_print=True, encoding="unicode"))


def _write(request: ExportRequest) -> Exported:
    address = EXAMPLE if request.like is None else RsiAddress.read(request.like, "--like")
    model = request.load()
    check_six_axes(model)
    comments = (
        f"Joint corrections of model {model.name} (robot {model.robot.name}) over RSI.",
        COUNTING.format(robot=model.robot.name),
        *pose_remarks(model),
    )
    text = rsi_configuration(address.host, address.port, comments)
    facts = model_facts(model) | {"address": f"{address.host}:{address.port}"}
    remarks = (*comments, *_REMARKS, *((SET_ADDRESS,) if request.like is None else ()))
    return Exported(text, facts, remarks, sentence_start="RSI configuration")


FORMAT = ExportFormat(
    "rsi",
    "an RSI configuration",
    (".xml",),
    _write,
    frozenset(("like",)),
    contains="joint_values",
)

"""Configuration of a KUKA controller that receives joint corrections over RSI from `pisigma serve --rsi`.

The format is the ETHERNET configuration of KUKA.RobotSensorInterface 3 and 4: in every interpolation cycle the
controller sends the commanded joint values (`ASPos`) [deg] and a time stamp (`IPOC`), and expects corrections of the
joints (`AKorr`) [deg] with the same time stamp. The file was loaded by RSIPI 0.3.0, not by a controller.
"""

import ipaddress

from lxml import etree

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import condition_remarks
from pisigma.deployment.export.programs.languages import COUNTING
from pisigma.files.errors import OutputError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.writing import comment_text

SENDER = "pisigma"
"""Name of the sender in answers (`SENTYPE`)."""
AXES = tuple(f"A{number}" for number in range(1, 7))
REMARKS = (
    "ASPos and AKorr are in degrees. AKorr are absolute corrections of the joint values that the controller computes "
    "with its nominal kinematics: RSI_ON(#ABSOLUTE). With #RELATIVE they would add up in every cycle.",
    "In the RSI context, connect the outputs 1 to 6 of ETHERNET to the inputs A1 to A6 of AXISCORR, set the limits of "
    "AXISCORR and AXISCORRMON to the largest correction that you accept, and Timeout of ETHERNET to 10 packets.",
    "Not tried on a controller: test it at low speed, with small limits of AXISCORR, away from obstacles.",
)


def parse_address(address: str) -> tuple[str, int]:
    """Split an address into IP address and port.

    Raises:
        OutputError: it is not of the form 192.168.1.10:49152.
    """
    host, _, port = address.rpartition(":")
    try:
        ipaddress.IPv4Address(host)
        if not 0 < int(port) < 65536:
            raise ValueError(port)
    except ValueError:
        raise OutputError(
            expected="an IPv4 address and a port, such as 192.168.1.10:49152",
            value=address,
            option="--address",
            remedy="state the address at which this computer receives the packets of the controller",
        ) from None
    return host, int(port)


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
    """Write the ETHERNET configuration; comments state units and what the RSI context needs."""
    root = etree.Element("ROOT")
    for sentence in (*comments, *REMARKS):
        root.append(etree.Comment(comment_text(sentence)))
    settings = etree.SubElement(root, "CONFIG")
    values = {"IP_NUMBER": host, "PORT": str(port), "SENTYPE": SENDER, "ONLYSEND": "FALSE"}
    for name, value in values.items():
        etree.SubElement(settings, name).text = value
    sent = etree.SubElement(etree.SubElement(root, "SEND"), "ELEMENTS")
    for tag, kind in (("DEF_ASPos", "DOUBLE"), ("DEF_Delay", "LONG")):
        etree.SubElement(sent, "ELEMENT", TAG=tag, TYPE=kind, INDX="INTERNAL")
    received = etree.SubElement(etree.SubElement(root, "RECEIVE"), "ELEMENTS")
    for number, axis in enumerate(AXES, 1):
        # A missed answer keeps the last correction (HOLDON), because 0 would be a jump.
        entry = {"TAG": f"AKorr.{axis}", "TYPE": "DOUBLE", "INDX": str(number), "HOLDON": "1"}
        etree.SubElement(received, "ELEMENT", entry)
    return str(etree.tostring(root, pretty_print=True, encoding="unicode"))


def _check(request: ExportRequest) -> None:
    if request.address is None:
        raise OutputError(
            "--format rsi needs the address at which this computer receives",
            option="--address",
            remedy="give --address, such as 192.168.1.10:49152",
        )
    parse_address(request.address)


def _write(request: ExportRequest) -> Exported:
    assert request.address is not None  # checked in `_check`
    host, port = parse_address(request.address)
    model = request.load()
    check_six_axes(model)
    comments = (
        f"Joint corrections of model {model.name} (robot {model.robot.name}) over RSI.",
        COUNTING.format(robot=model.robot.name),
        *condition_remarks(model),
    )
    text = rsi_configuration(host, port, comments)
    facts = model_facts(model) | {"address": request.address}
    return Exported(text, facts, (*comments, *REMARKS), summary="RSI configuration")


FORMAT = ExportFormat(
    "rsi",
    "an RSI configuration",
    (".xml",),
    _write,
    frozenset(("address",)),
    _check,
    contains="joint_values",
)

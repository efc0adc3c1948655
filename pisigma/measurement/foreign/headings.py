"""Registry of the column headings of manufacturers and instruments, and their meanings."""

import re
from dataclasses import dataclass

from pisigma.files.errors import MAX_WORD_CHARACTERS
from pisigma.measurement.csv.columns import find_column
from pisigma.measurement.foreign.rotations import ROTATIONS
from pisigma.measurement.foreign.units import ambiguous_unit, unit_symbol

_SIDES = {
    "commanded": "target cmd command commanded setpoint soll nominal nom ref reference desired robot",
    "measured": "actual act meas measured ist tracker reflector smr laser",
    "": "tcp tool pos position pose coord coordinate coordinates value values val jnt trans translation",
}
"""Words that may accompany a name: those for commanded values, those for measured values, and words without meaning."""
_SIDE_OF = {word: side for side, words in _SIDES.items() for word in words.split()}
_OF_QUATERNION = re.compile(r"^(?:rot|rotation|ori|orient|orientation|quat|quaternion)(?=q[0-4xyzw]$)")
_BRACKETS = re.compile(r"^(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\)|<([^>]*)>)\s*$")
_TRAILING = re.compile(r"^(.*?)(?:\s*/\s*|\s+in\s+|[\s_,-]+)([A-Za-z°µμ]+)\.?$")


@dataclass(frozen=True)
class Heading:
    """A parsed heading.

    Attributes:
        text: the heading as in the file.
        name: name in the heading without unit, case, separators and words without meaning, such as "j1" for "J_1
            [deg]".
        unit: symbol of the unit, or "".
        unknown_unit: text in brackets that is not a unit.
        value_kind: "commanded" or "measured" if the heading states it, otherwise "".
        is_column_name: whether the heading is the name of a column of measurement files, in upper or lower case.
    """

    text: str
    name: str
    unit: str
    unknown_unit: str = ""
    value_kind: str = ""
    is_column_name: bool = False


def parse_heading(text: str) -> Heading:
    """Parse a heading; a heading that is too long gets no meaning."""
    if len(text) > MAX_WORD_CHARACTERS:
        return Heading(text, "", "")
    column = find_column(text.strip().lower())
    if column is not None:
        return Heading(text, column.quantity, column.unit, is_column_name=True)
    name, unit, unknown = _unit_apart(text.strip())
    words = [word for word in re.split(r"[\W_]+", name.casefold()) if word]
    side = next(filter(None, (_SIDE_OF.get(word) for word in words)), "")
    for sides in (("commanded", "measured"), ("",)):
        others = [word for word in words if _SIDE_OF.get(word) not in sides]
        words = others if others and not all(word.isdigit() for word in others) else words
    name = _OF_QUATERNION.sub("", "".join(words))
    return Heading(text, name, unit, unknown, side)


def _unit_apart(text: str) -> tuple[str, str, str]:
    """Return the name in a heading, the symbol of its unit, and a text in brackets that is not a unit."""
    match = _BRACKETS.match(text)
    if match:
        inside = next(group for group in match.groups()[1:] if group is not None)
        symbol = unit_symbol(inside)
        return match[1] or inside, symbol, "" if symbol or not match[1] else inside
    match = _TRAILING.match(text)
    if match and match[1] and (symbol := unit_symbol(match[2])):
        return match[1], symbol, ""
    if match and match[1] and (spelling := ambiguous_unit(match[2])):
        return match[1], "", spelling
    return text, "", ""


@dataclass(frozen=True)
class MakerHeadings:
    """Column names that a manufacturer uses.

    Attributes:
        name: name of the manufacturer.
        joints: names of the joints in order, or one name that is followed by numbers; "" if the names are not specific.
        rotation_encoding: name of the manufacturer's encoding of rotations.
        x_heading: name of the coordinate x, if it is needed to recognise the manufacturer.
        length_unit: unit of all lengths; "" if it is configurable.
        angle_unit: unit of all angles; "" if it is configurable.
    """

    name: str
    joints: str = ""
    rotation_encoding: str = ""
    x_heading: str = ""
    length_unit: str = ""
    angle_unit: str = ""


MAKERS = (
    MakerHeadings("KUKA", "a#", "kuka", length_unit="mm", angle_unit="deg"),
    MakerHeadings("ABB", "rax#", "abb", length_unit="mm", angle_unit="deg"),
    MakerHeadings("Kawasaki", "jt#", "kawasaki", length_unit="mm", angle_unit="deg"),
    MakerHeadings("Yaskawa", "s l u r b t", "yaskawa", length_unit="mm", angle_unit="deg"),
    MakerHeadings("Universal Robots", "q#", "ur", "tcppose0", "m", "rad"),
    MakerHeadings("Universal Robots", "base shoulder elbow wrist1 wrist2 wrist3", "ur"),
    MakerHeadings("FANUC", "", "fanuc", length_unit="mm", angle_unit="deg"),
    MakerHeadings("Epson", "", "epson", length_unit="mm", angle_unit="deg"),
    MakerHeadings("Kawasaki", "", "kawasaki", length_unit="mm", angle_unit="deg"),
)
"""Column names of manufacturers, one per line. Manufacturers without specific joint names are recognised by their
rotations."""

_JOINTS = "j joint q axis ax achse th theta gelenk axe eje asse jt a rax position"
JOINT_NAMES = tuple(_JOINTS.split())
"""Names of joints, followed by numbers, that any manufacturer may use."""

POSITIONS = tuple(
    tuple(names.split())
    for names in (
        "x y z",
        "px py pz",
        "tcppose0 tcppose1 tcppose2",
        "t14 t24 t34",
        "m14 m24 m34",
        "m03 m13 m23",
        "r14 r24 r34",
    )
)
"""Names of the coordinates of a position, one text per set of names."""

_MEANINGS = {
    "point": "point pointname punkt punktname pt ptname pos name label pointid id measurement no nr num number index",
    "time": "time timestamp zeit datetime date_time utc stamp systemtime",
    "temperature": "temperature temp temperatur",
    "payload": "payload",
    "set": "set split",
}
MEANINGS = {name: quantity for quantity, names in _MEANINGS.items() for name in names.split()}
"""Names of other quantities, in the order of preference, separated by spaces."""
_OTHERS = {
    name
    for names in (
        *POSITIONS,
        *(values for one in ROTATIONS.values() for values in (one.values, *one.aliases)),
    )
    for name in names
} | set(MEANINGS)


def joint_of(name: str, pattern: str) -> int | None:
    """Return the number of the joint that a name denotes, as written; None if the name does not denote a joint.

    Args:
        name: name in a heading.
        pattern: names of the joints that the manufacturer uses, see `MakerHeadings.joints`.
    """
    if not pattern.endswith("#"):
        names = pattern.split()
        return names.index(name) + 1 if name in names else None
    start, number = pattern[:-1], name[len(pattern) - 1 :]
    return int(number) if name.startswith(start) and re.fullmatch(r"[0-9]{1,3}", number) else None


def is_recognised(text: str) -> bool:
    """Return whether a heading has a known meaning."""
    heading = parse_heading(text)
    patterns = (*(f"{name}#" for name in JOINT_NAMES), *(maker.joints for maker in MAKERS if maker.joints))
    return (
        heading.is_column_name
        or heading.name in _OTHERS
        or any(joint_of(heading.name, one) for one in patterns)
    )

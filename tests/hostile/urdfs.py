"""Hostile URDF files: trees that are not a chain, values that are not valid, and malicious XML."""

import copy
from pathlib import Path
from xml.etree import ElementTree

from hostile.case import Case, Rng, calibrate, one_of
from hostile.clean import Clean
from hostile.damage import NUMBERS, TEXTS, damaged

_VECTORS = (
    "0 0 0",
    "1 1",
    "1 2 3 4",
    "nan 0 0",
    "1e300 0 0",
    "a b c",
    "",
    "1,2,3",
    "0 0 1e-200",
    "inf 0 0",
    "1 1 1",
    "0,0 0,5 0",
)
_TYPES = ("floating", "planar", "spherical", "Revolute", "", "continuous", "prismatic", "fixed", "mimic")
_BOMB = (
    '<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {c} "{f"&{b};" * 10}">' for b, c in zip("abcdefgh", "bcdefghi", strict=True))
    + ']><robot name="&i;"><link name="a"/></robot>'
)
_BOMBS = (
    _BOMB,
    '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"><link name="a"/></robot>',
    '<!DOCTYPE robot SYSTEM "http://127.0.0.1:9/x.dtd"><robot name="r"><link name="a"/></robot>',
    '<robot name="r" xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="/etc/passwd" parse="text"/></robot>',
    "<robot>" + "<link>" * 3000 + "</link>" * 3000 + "</robot>",
    '<?xml version="1.0" encoding="utf-16"?><robot name="r"/>',
    '<?xml version="1.0" encoding="no-such"?><robot name="r"/>',
    '<sdf version="1.6"><model name="r"/></sdf>',
    '<robot name="r"/>',
    '<robot name="r"><link name="a"/></robot>',
    "<robot><![CDATA[" + "x" * 100_000 + "]]></robot>",
    '<robot name="${name}" xmlns:xacro="x"><xacro:property name="a" value="1"/></robot>',
    "<a/><b/>",
)


def wrong_urdf(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a wrong robot in URDF."""
    path, draw = one_of(rng, list(clean.urdfs)), rng.random()
    name = clean.urdfs[path]
    if draw < 0.2:
        what, content = damaged(rng, path.read_bytes())
    elif draw < 0.3:
        index = int(rng.integers(len(_BOMBS)))
        what, content = f"bomb {index}", _BOMBS[index].encode()
    else:
        what, content = _mutated(rng, path)
    (folder / "robot.urdf").write_bytes(content)
    ends = ((), (), (), ("--tip", "link_2"), ("--base", "link_1"), ("--tip", "nowhere"), ("--base", "tool0"))
    rows = clean.rows[name]
    return Case(f"{name}: {what}", calibrate("robot.urdf", str(rows.path), *one_of(rng, ends)), rows)


def _mutated(rng: Rng, path: Path) -> tuple[str, bytes]:
    root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    done = []
    for _ in range(one_of(rng, (1, 1, 2))):
        change = one_of(rng, _CHANGES)
        done.append(change.__name__.strip("_").replace("_", " "))
        change(rng, root)
    return ", ".join(done), ElementTree.tostring(root)


def _joints(root: ElementTree.Element) -> list[ElementTree.Element]:
    return root.findall("joint") or [ElementTree.SubElement(root, "joint")]


def _element_gone(rng: Rng, root: ElementTree.Element) -> None:
    parent = one_of(rng, [element for element in root.iter() if len(element)] or [root])
    if len(parent):
        parent.remove(one_of(rng, list(parent)))


def _element_twice(rng: Rng, root: ElementTree.Element) -> None:
    parent = one_of(rng, [element for element in root.iter() if len(element)] or [root])
    if len(parent):
        parent.extend([copy.deepcopy(one_of(rng, list(parent)))] * one_of(rng, (1, 1, 500)))


def _attribute_gone(rng: Rng, root: ElementTree.Element) -> None:
    element = one_of(rng, [element for element in root.iter() if element.attrib] or [root])
    if element.attrib:
        del element.attrib[one_of(rng, list(element.attrib))]


def _attribute_replaced(rng: Rng, root: ElementTree.Element) -> None:
    element = one_of(rng, [element for element in root.iter() if element.attrib] or [root])
    text = one_of(rng, (*NUMBERS, *TEXTS, *_VECTORS))
    element.set(one_of(rng, [*element.attrib, "name"]), "".join(c for c in text if c >= " "))


def _vector_replaced(rng: Rng, root: ElementTree.Element) -> None:
    element = one_of(rng, [e for e in root.iter() if e.tag in ("origin", "axis")] or [root])
    element.set(one_of(rng, ("xyz", "rpy")), one_of(rng, _VECTORS))


def _links_exchanged(rng: Rng, root: ElementTree.Element) -> None:
    first, second = one_of(rng, _joints(root)), one_of(rng, _joints(root))
    for one, other in (
        (first.find("parent"), second.find("child")),
        (first.find("child"), second.find("parent")),
    ):
        if one is not None and other is not None:
            one.set("link", other.get("link", ""))


def _second_leaf(rng: Rng, root: ElementTree.Element) -> None:
    ElementTree.SubElement(root, "link", name="branch")
    joint = ElementTree.SubElement(root, "joint", name="to_branch", type=one_of(rng, _TYPES))
    links = [link.get("name", "") for link in root.findall("link")]
    ElementTree.SubElement(joint, "parent", link=one_of(rng, links))
    ElementTree.SubElement(joint, "child", link=one_of(rng, ("branch", *links)))


def _another_type(rng: Rng, root: ElementTree.Element) -> None:
    one_of(rng, _joints(root)).set("type", one_of(rng, _TYPES))


def _mimic(rng: Rng, root: ElementTree.Element) -> None:
    joints = _joints(root)
    names = ("nowhere", *(joint.get("name", "") for joint in joints))
    for joint in joints[: one_of(rng, (1, 2, len(joints)))]:
        ElementTree.SubElement(
            joint, "mimic", joint=one_of(rng, names), multiplier=one_of(rng, ("1", "0", "-1", "x", "1e300"))
        )


def _limits(rng: Rng, root: ElementTree.Element) -> None:
    for limit in root.iter("limit"):
        limit.set("lower", one_of(rng, ("3", "0", "nan", "-1e300", "x", "")))
        limit.set("upper", one_of(rng, ("-3", "0", "1e-9", "inf", "y")))


def _stretched(rng: Rng, root: ElementTree.Element) -> None:
    factor = one_of(rng, (0.0, 1e-3, 1e3, 10.0, 1e200))
    for origin in root.iter("origin"):
        numbers = [float(word) * factor for word in origin.get("xyz", "0 0 0").split()]
        origin.set("xyz", " ".join(map(str, numbers)))


_CHANGES = (
    _element_gone, _element_twice, _attribute_gone, _attribute_replaced, _vector_replaced, _vector_replaced,
    _links_exchanged, _second_leaf, _another_type, _mimic, _limits, _stretched,
)  # fmt: skip

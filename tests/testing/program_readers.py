"""Content of programs for robot controllers, read with their grammars."""

from dataclasses import dataclass, field

from lark import Lark, Token, Transformer, Tree
from testing.program_grammars import FANUC, KRL, RAPID, URSCRIPT

EXTERNAL = [9e9] * 6


@dataclass
class Program:
    """Content of a program.

    Attributes:
        name: name of the program.
        remarks: its comments in order, without comment marks.
        speeds: constants that limit its speed.
        joints: joint values of every joint move, in the language's unit.
        poses: pose of every move to a pose, as the language writes it.
        frame: frame of the poses; None without one. FANUC's frame and tool are in remarks.
        tool: tool of the poses.
        near: for URScript, the joint values next to each pose.
        config: for FANUC, the configurations.
    """

    name: str = ""
    remarks: list[str] = field(default_factory=list)
    speeds: dict[str, object] = field(default_factory=dict)
    joints: list[list[float]] = field(default_factory=list)
    poses: list[list[float]] = field(default_factory=list)
    frame: list[float] | None = None
    tool: list[float] | None = None
    near: list[list[float]] = field(default_factory=list)
    config: set[str] = field(default_factory=set)


class _Values(Transformer):
    """Literals as Python values."""

    def NUMBER(self, token: Token) -> float:
        return float(token)

    REAL = NUMBER

    def INTEGER(self, token: Token) -> int:
        return int(token)

    def list(self, children: list) -> list:
        return children

    array = list

    def pose(self, children: list) -> object:
        return ("p", children[0]) if len(children) == 1 else Tree("pose", children)


def _tree(grammar: str, text: str, parser: str = "lalr") -> Tree:
    return _Values().transform(Lark(grammar, parser=parser).parse(text))


def _remarks(tree: Tree) -> list[str]:
    return [
        str(token)[1:].strip() for token in tree.scan_values(lambda t: getattr(t, "type", "") == "REMARK")
    ]


def read_urscript(text: str) -> Program:
    """Read a program, and evaluate its assignments."""
    tree = _tree(URSCRIPT, text)
    name, *_ = [child for child in tree.children if getattr(child, "type", "") == "NAME"]
    program, variables = Program(str(name), _remarks(tree)), {}
    for node in tree.children:
        if not isinstance(node, Tree):
            continue
        if node.data == "assignment":
            variable, value = node.children
            variables[str(variable)] = value
            continue
        function, *arguments = node.children
        if function == "set_tcp":
            ((_, program.tool),) = arguments
        else:
            assert function == "movej", function
            goal, *named = arguments
            assert [(str(n.children[0]), str(n.children[1])) for n in named] == [
                ("a", "acceleration"), ("v", "speed")
            ]  # fmt: skip
            _urscript_goal(goal, variables, program)
    program.speeds = {key: variables[key] for key in ("speed", "acceleration")}
    return program


def _urscript_goal(goal: object, variables: dict, program: Program) -> None:
    if isinstance(goal, list):
        assert len(goal) == 6
        program.joints.append(goal)
        return
    assert isinstance(goal, Tree)
    function, transformed, near = goal.children
    assert function == "get_inverse_kin"
    inner, frame, (_, pose) = transformed.children
    assert (str(inner), str(frame)) == ("pose_trans", "frame")
    (_, program.frame) = variables["frame"]
    assert (len(pose), len(near), len(program.frame), len(program.tool or [])) == (6, 6, 6, 6)
    program.poses.append(pose)
    program.near.append(near)


def read_krl(text: str) -> Program:
    """Read a program; the first move of a program of frames is a joint move in `joints`."""
    assert max(map(len, text.split("\r\n"))) <= 254
    tree = _tree(KRL, text)
    _, name, *rest = tree.children
    program = Program(str(name), _remarks(tree))
    for node in rest:
        if not isinstance(node, Tree):
            continue
        if node.data == "move":
            kind, values = _krl_aggregate(node.children[0])
            (program.joints if kind == "AXIS" else program.poses).append(values)
        elif node.data == "assignment":
            target, value = node.children
            if target.children[0] == "$BASE":
                program.frame = _krl_aggregate(value)[1]
            elif target.children[0] == "$TOOL":
                program.tool = _krl_aggregate(value)[1]
            else:
                program.speeds[str(target.children[0])] = value
        else:
            _, first, last, *assignments = node.children
            assert (first, last) == (1, 6)
            program.speeds |= {str(a.children[0].children[0]): str(a.children[1]) for a in assignments}
    return program


def _krl_aggregate(tree: Tree) -> tuple[str, list[float]]:
    kind, *components = tree.children
    letters = [str(component.children[0]) for component in components]
    assert letters == ([f"A{i}" for i in range(1, 7)] if kind == "AXIS" else list("XYZABC"))
    return str(kind), [component.children[1] for component in components]


def read_rapid(text: str) -> Program:
    """Read a module; the first move of a program of robtargets is a joint move in `joints`."""
    tree = _tree(RAPID, text)
    program = Program(str(tree.children[0]), _remarks(tree))
    data = {
        str(name): (str(kind), value)
        for kind, name, value in (node.children[-3:] for node in tree.find_data("data"))
    }
    (procedure,) = tree.find_data("procedure")
    assert procedure.children[0] == f"{program.name}_run"
    program.speeds = {"slow": data["slow"][1]}
    assert data["slow"][0] == "speeddata"
    for move in procedure.children:
        if not isinstance(move, Tree) or move.data == "configuration":
            continue
        target, speed, zone, tool, *wobj = move.children
        assert (speed, zone) == ("slow", "fine")
        if tool != "tool0":
            kind, (held, pose, _) = data[str(tool)]
            assert (kind, str(held)) == ("tooldata", "TRUE")
            program.tool = [*pose[0], *pose[1]]
        if move.data == "axes":
            axes, external = target
            assert (len(axes), external) == (6, EXTERNAL)
            program.joints.append(axes)
        else:
            position, turn, configuration, external = target
            assert (len(position), len(turn), len(configuration), external) == (3, 4, 4, EXTERNAL)
            program.poses.append([*position, *turn])
            kind, (held, fixed, unit, frame, inner) = data[str(wobj[0])]
            assert (kind, held, fixed, unit) == ("wobjdata", "FALSE", "TRUE", '""')
            assert inner == [[0, 0, 0], [1, 0, 0, 0]]
            program.frame = [*frame[0], *frame[1]]
    return program


def read_fanuc(text: str) -> Program:
    """Read a TP program."""
    tree = _tree(FANUC, text)
    program = Program(str(tree.children[0]), _remarks(tree))
    attributes = {
        str(key): value
        for node in tree.find_data("attribute")
        for key, value in zip(node.children[::2], node.children[1::2], strict=True)
    }
    lines = list(tree.find_data("line"))
    assert [line.children[0] for line in lines] == list(range(1, len(lines) + 1))
    assert int(attributes["LINE_COUNT"]) == len(lines)
    moves = [line.children[1] for line in lines if isinstance(line.children[1], Tree)]
    numbers = {str(m.children[0]): m.children[1] for m in moves if m.data == "setting"}
    order = [m.children[0] for m in moves if m.data == "move"]
    program.speeds = {"percent": {int(m.children[1]) for m in moves if m.data == "move"}}
    positions = {node.children[0]: node.children[1:] for node in tree.find_data("position")}
    assert order == list(positions) == list(range(1, len(positions) + 1))
    for uframe, utool, where in positions.values():
        assert (uframe, utool) == (numbers["UFRAME_NUM"], numbers["UTOOL_NUM"])
        parts = [part for part in where.children if isinstance(part, Tree)]
        labels = [str(part.children[0]) for part in parts]
        values = [part.children[1] for part in parts]
        if where.data == "joints":
            assert labels == [f"J{i}" for i in range(1, 7)]
            program.joints.append(values)
        else:
            assert labels == list("XYZWPR")
            program.poses.append(values)
            program.config.add(str(where.children[0]).strip("'"))
            program.frame, program.tool = (
                _stated_values(program.remarks, f"{kind} 1 has to be") for kind in ("UFRAME", "UTOOL")
            )
    return program


def _stated_values(remarks: list[str], title: str) -> list[float]:
    """Return X, Y, Z, W, P, R of the three remarks after a title."""
    begin = remarks.index(title) + 1
    words = " ".join(remarks[begin : begin + 3]).replace(",", "").split()
    assert words[::2] == list("XYZWPR")
    return [float(word) for word in words[1::2]]


READERS = {".script": read_urscript, ".src": read_krl, ".mod": read_rapid, ".ls": read_fanuc}
"""Readers by the suffix of the file."""

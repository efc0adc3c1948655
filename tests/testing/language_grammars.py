"""Grammars of robot languages as their manufacturers describe them, and what a grammar without context cannot state."""

import functools
import re
from pathlib import Path

from lark import Lark, Token, Tree

GRAMMARS = Path(__file__).parents[1] / "deployment/export/grammars"
FILES = {".script": "urscript.lark", ".src": "krl.lark", ".dat": "krl.lark", ".ls": "fanuc.lark"}
FUNCTIONS = """
acos asin atan atan2 cos exp floor get_actual_joint_positions get_actual_tcp_pose get_digital_in
get_standard_digital_in get_steptime get_tcp_offset interpolate_pose length movec movel movep norm pose_add pose_dist
pose_inv pose_sub popup pow set_digital_out set_gravity set_payload set_standard_digital_out sin sleep speedj speedl
sqrt stopj stopl str_cat tan textmsg to_str
"""
"""Functions of URScript that programs may call, in addition to those of its grammar. Source: script manual."""


@functools.cache
def parser(grammar: str) -> Lark:
    return Lark((GRAMMARS / grammar).read_text(), parser="lalr")


def check_program(suffix: str, text: str) -> Tree:
    """Parse a program and check the names and numbers that refer to each other.

    Raises:
        LarkError: it violates the grammar.
        AssertionError: a function is unknown, a line is counted wrongly or a position is missing.
    """
    tree = parser(FILES[suffix]).parse(text)
    if suffix == ".script":
        known = {str(node.children[0]) for name in ("function", "thread") for node in tree.find_data(name)}
        called = {str(node.children[0]) for node in tree.find_data("call")}
        assert not (unknown := called - known - set(FUNCTIONS.split())), unknown
    elif suffix == ".ls":
        _check_numbers(tree)
    return tree


def _check_numbers(tree: Tree) -> None:
    """Check that lines count from 1 to LINE_COUNT, and that every position of a move is given."""
    lines = [int(node.children[0]) for node in tree.find_data("line")]
    assert lines == list(range(1, len(lines) + 1))
    counts = [n.children[1] for n in tree.find_data("attribute") if n.children[:1] == ["LINE_COUNT"]]
    assert [int(count) for count in counts] in ([], [len(lines)])
    given = [_number(node.children[0]) for node in tree.find_data("position")]
    assert len(given) == len(set(given))
    moves = tree.find_data("motion")
    assert {_number(goal) for move in moves for goal in move.children if _is_position(goal)} <= set(given)


def _is_position(child: object) -> bool:
    return isinstance(child, Token) and child.type == "P"


def _number(position: object) -> int:
    (digits,) = re.findall(r"P\[([0-9]+)", str(position))
    return int(digits)

"""Messages are built from fields and are safe to print on a terminal."""

import ast
import json
import pickle
from pathlib import Path

import pytest

import pisigma
from pisigma.files.errors import (
    MAX_MESSAGE_CHARACTERS,
    MissingExtraError,
    Phrase,
    PisigmaError,
    Place,
    RobotError,
    make_printable,
)


@pytest.mark.parametrize("odd", ["\x1b[31m", "\x00", "\x9b2J", "\u202e", "\udcff", "\x07", "\r"])
def test_control_characters_are_escaped(odd: str):
    sentence = str(RobotError(f"row '{odd}': unknown"))
    assert sentence == f"row '{ascii(odd)[1:-1]}': unknown"
    assert sentence.isprintable()


def test_printable_text_is_unchanged():
    assert make_printable("Größe 10°, 測定, a\tb\nc") == "Größe 10°, 測定, a\tb\nc"


def test_long_words_and_texts_are_shortened():
    assert (
        make_printable(f"'{'x' * 1_000_000}' is unknown")
        == f"'{'x' * 39}... (1,000,002 characters) is unknown"
    )
    shown = str(MissingExtraError("no " * 1_000_000 + "end"))
    assert len(shown) < MAX_MESSAGE_CHARACTERS
    assert shown.endswith("no end")


def test_a_message_is_built_from_its_fields():
    problem = RobotError(
        expected="a length > 0",
        value=-3.0,
        at=Place("cell.yaml", 12, "links.2"),
        remedy="give a positive length",
    )
    assert (
        str(problem)
        == "expected a length > 0, got -3 (cell.yaml, line 12, key 'links.2'); give a positive length."
    )
    assert (problem.file, problem.line, problem.column, problem.value) == ("cell.yaml", 12, "links.2", -3.0)
    assert (
        str(PisigmaError(expected="a file", value="x", option="--camera"))
        == "--camera: expected a file, got 'x'."
    )
    assert str(PisigmaError("no rows", at=Place("a.csv", 3, 2))) == "no rows (a.csv, line 3, column 2)."
    assert str(PisigmaError(expected="rows", value=Phrase("none"))) == "expected rows, got none."
    assert str(PisigmaError("the whole message")) == "the whole message"


def test_fields_are_plain_values_for_json():
    problem = RobotError(expected="six joints", value=(3, 4), at=Place("a.csv", 3))
    assert json.loads(json.dumps(problem.fields())) == {
        "class": "RobotError",
        "message": "expected six joints, got (3, 4) (a.csv, line 3).",
        "file": "a.csv",
        "line": 3,
        "value": "(3, 4)",
        "expected": "six joints",
    }


def test_a_place_is_added_to_an_error_without_one():
    problem = RobotError("no rows", value=0, remedy="add rows").with_place(Place("a.csv", 3), PisigmaError)
    assert type(problem) is PisigmaError
    assert str(problem) == "no rows (a.csv, line 3); add rows."
    assert (problem.file, problem.line, problem.value) == ("a.csv", 3, 0)
    again = problem.with_place(Place("b.yaml", 7, "rows"))
    assert (again.file, again.line, again.column) == ("a.csv", 3, None)
    assert str(again) == "b.yaml, line 7, key 'rows': no rows (a.csv, line 3); add rows."
    more = PisigmaError("no rows").with_text_after(" See the log.").with_place(Place("a.csv", 3))
    assert (str(more), more.line) == ("a.csv, line 3: no rows See the log.", 3)
    assert (
        str(PisigmaError(expected="a row", value=0).with_place(Place("a", 1)))
        == "expected a row, got 0 (a, line 1)."
    )


def test_fields_survive_pickling_and_an_appended_text():
    problem = RobotError("no rows", at=Place("a.csv", 3), value=0, option="--rows")
    for other in (pickle.loads(pickle.dumps(problem)), problem.with_text_after(" See the log.")):
        assert type(other) is RobotError
        assert {**other.fields(), "message": ""} == {**problem.fields(), "message": ""}
    assert str(problem.with_text_after(" See the log.")) == "--rows: no rows (a.csv, line 3). See the log."


def test_no_problem_ends_in_parentheses_before_its_place():
    """The place of an error follows in parentheses."""
    doubled = []
    for path in Path(pisigma.__file__).parent.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(call, ast.Call):
                continue
            keywords = {one.arg: one.value for one in call.keywords}
            before = call.args[0] if call.args else None if "value" in keywords else keywords.get("expected")
            if isinstance(before, ast.JoinedStr):
                before = before.values[-1]
            if "at" in keywords and isinstance(before, ast.Constant) and str(before.value).endswith(")"):
                doubled.append(f"{path}, line {call.lineno}")
    assert doubled == []

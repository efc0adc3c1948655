"""YAML files: plain values as written, strict types, errors with file, line and key."""

from typing import Annotated, Literal

import pytest
import yaml
from pydantic import Field
from testing.refusals import refused

from pisigma.files.errors import Place, RecipeError
from pisigma.files.yaml_file import Section, parse_yaml, place_of_key, read_yaml
from pisigma.files.yaml_writing import yaml_text


class Circle(Section):
    kind: Literal["circle"]
    radius_mm: float


class Square(Section):
    kind: Literal["square"]
    side_mm: float


class Drawing(Section):
    name: str
    count: int = 1
    scale: float = 1.0
    closed: bool = False
    colour: Literal["red", "green"] = "red"
    sizes: dict[str, Circle] = {}  # noqa: RUF012
    shapes: tuple[Annotated[Circle | Square, Field(discriminator="kind")], ...] = ()
    corner: tuple[float, float] | None = None


def read(text: str) -> Drawing:
    return parse_yaml(text, Drawing, RecipeError, "d.yaml")


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e-3", 1e-3), ("-2.5E+3", -2500.0), (".5", 0.5), ("1.", 1.0), ("7", 7.0), ("+7", 7.0), ("010", 10.0)],
)
def test_numbers_are_what_they_look_like(text, value):
    assert read(f"name: a\nscale: {text}").scale == value


def test_integers_are_decimal():
    assert read("name: a\ncount: 010").count == 10


@pytest.mark.parametrize("text", ["no", "2024-01-31", "1:30", "on", "'7'", "a b", "1_000"])
def test_texts_remain_texts(text):
    assert read(f"name: {text}").name == text.strip("'")


@pytest.mark.parametrize(
    ("text", "line", "column", "expected", "value"),
    [
        ("name: a\ncount: 2.5", 2, "count", "a valid integer", 2.5),
        ("name: a\ncount: yes", 2, "count", "a valid integer", "yes"),
        ("name: a\ncount: true", 2, "count", "a valid integer", True),
        ("name: a\nscale: true", 2, "scale", "a valid number", True),
        ("name: a\nscale: '1'", 2, "scale", "a valid number", "1"),
        ("name: a\nscale: -.inf", 2, "scale", "a finite number", float("-inf")),
        ("name: a\nscale: 1:30", 2, "scale", "a valid number", "1:30"),
        ("name: 7", 1, "name", "a valid string", 7),
        ("name:", 1, "name", "a valid string", None),
        ("name: a\ncorner: [1, x]", 2, "corner.1", "a valid number", "x"),
        ("count: 2", 1, "name", "a value", None),
        ("name: a\nshapes:\n- radius_mm: 1", 3, "shapes.0.kind", "a value", None),
        ("name: a\nshapes:\n- kind: square", 3, "shapes.0.side_mm", "a value", None),
        ("name: a\nname: b", 2, None, "valid YAML", None),
        ("5: a", 1, None, "valid YAML", None),
        ("[a]: b", 1, None, "valid YAML", None),
        ("- a\n- b", None, None, "a YAML mapping of keys to values", None),
        ("", None, None, "a YAML mapping of keys to values", None),
        ("# nothing", None, None, "a YAML mapping of keys to values", None),
        ("name: [", 1, None, "valid YAML", None),
        ("name: a\n\tcount: 1", 2, None, "valid YAML", None),
        ("name: a\x00", None, None, "valid YAML", None),
        ("name: !!python/object:os.system x", 1, None, "valid YAML", None),
        ("name: !!set {a, b}", None, None, "plain values", None),
        ("name: a\ncount: !!int abc", 2, None, "valid YAML", None),
        ("name: a\ncount: " + 5000 * "9", 2, "count", "a valid integer", float("inf")),
        ("name: " + 3000 * "[", None, None, "valid YAML", None),
        ("name: &a [*a]", None, None, "valid YAML", None),
        ("a: &a0 [x, x]\n" + "\n".join(f"b{i}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]" for i in range(9)),
         None, None, "200000 values or fewer", None),
    ],
)  # fmt: skip
def test_errors_state_place_and_expectation(text, line, column, expected, value):
    with refused(
        RecipeError, file="d.yaml", line=line, column=column, expected=expected, value=value
    ) as caught:
        read(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "line", "column", "value", "hint"),
    [
        ("name: a\ncuont: 2", 2, "cuont", "cuont", "count"),
        ("name: a\ncolour: gren", 2, "colour", "gren", "green"),
        ("name: a\nshapes:\n- kind: circel\n  radius_mm: 1", 3, "shapes.0.kind", "circel", "circle"),
        ("name: a\nshapes:\n- kind: circle\n  side_mm: 1", 4, "shapes.0.side_mm", "side_mm", "radius_mm"),
        ("name: a\nsizes: {b: {kind: circle, radius: 1}}", 2, "sizes.b.radius", "radius", "radius_mm"),
    ],
)
def test_errors_name_the_nearest_choice(text, line, column, value, hint):
    with refused(RecipeError, file="d.yaml", line=line, column=column, value=value) as caught:
        read(text)
    assert hint in caught.value.remedy


def test_not_a_number_is_rejected():
    with refused(RecipeError, line=2, column="scale", expected="a finite number"):
        read("name: a\nscale: .nan")


def test_files_that_cannot_be_read(tmp_path):
    with refused(RecipeError, file="none.yaml", value="No such file or directory"):
        read_yaml(tmp_path / "none.yaml", Drawing, RecipeError)
    with refused(RecipeError, file=tmp_path, value="Is a directory"):
        read_yaml(tmp_path, Drawing, RecipeError)
    (tmp_path / "latin.yaml").write_bytes(b"name: \xe9")
    with refused(RecipeError, file="latin.yaml", line=1, value="0xe9"):
        read_yaml(tmp_path / "latin.yaml", Drawing, RecipeError)


def test_a_byte_order_mark_and_aliases_are_read(tmp_path):
    text = "﻿name: a\nshapes:\n- &one {kind: circle, radius_mm: 1}\n- *one\n"
    (tmp_path / "d.yaml").write_text(text, encoding="utf-8")
    assert len(read_yaml(tmp_path / "d.yaml", Drawing, RecipeError).shapes) == 2


def test_the_place_of_a_value(tmp_path):
    path = tmp_path / "d.yaml"
    path.write_text("name: a\nshapes:\n- kind: circle\n\n- kind: square\n  side_mm: 1\n")
    assert place_of_key(path, ("name",)) == Place(path, 1, "name")
    assert place_of_key(path, ("shapes",)) == Place(path, 2, "shapes")
    assert place_of_key(path, ("shapes", 1)) == Place(path, 5, "shapes.1")
    assert place_of_key(path, ("shapes", 1, "side_mm")) == Place(path, 6, "shapes.1.side_mm")
    assert place_of_key(path, ("shapes", 1, "nothing")).line == 5


def test_an_alias_bomb_of_long_texts_is_rejected(tmp_path):
    """80 kB that would take 3 GB."""
    path = tmp_path / "d.yaml"
    path.write_text(f"name: &a {'x' * 40_000}\nshapes: [{', '.join(['*a'] * 10_000)}]\n")
    with refused(RecipeError, file="d.yaml", expected="200000 values or fewer"):
        read_yaml(path, Drawing, RecipeError)


def test_a_file_too_large_for_people_is_rejected_before_it_is_parsed(tmp_path):
    path = tmp_path / "d.yaml"
    path.write_text(
        "name: a\nsizes:\n" + "".join(f"  {i}: {{kind: circle, radius_mm: 1}}\n" for i in range(10_000))
    )
    with refused(RecipeError, file="d.yaml", expected=f"{2**18} bytes or fewer"):
        read_yaml(path, Drawing, RecipeError)


@pytest.mark.parametrize("text", ["1e3", "on", "0o7", "2024-01-31", "1_000", "null", "-", "x: y", " a"])
def test_written_texts_are_read_back_unchanged(text):
    assert read(yaml_text({"name": text})).name == text
    assert yaml.safe_load(yaml_text({"name": text})) == {"name": text}

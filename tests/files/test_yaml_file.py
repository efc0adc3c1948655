"""YAML files: plain values as written, strict types, complaints of one sentence with file, line and key."""

from typing import Annotated, Literal

import pytest
import yaml
from pydantic import Field

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Section, line_of, parse_yaml, read_yaml, yaml_text


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
def test_texts_stay_texts(text):
    assert read(f"name: {text}").name == text.strip("'")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("name: a\ncuont: 2", "d.yaml, line 2: unknown key 'cuont' in 'the file'; did you mean 'count'? Valid:"),
        ("count: 2", "d.yaml, line 1: the key 'name' is missing in 'the file'; add it."),
        ("name: a\nname: b", "d.yaml, line 2: the key 'name' stands twice; correct the YAML there."),
        ("name: a\ncount: 2.5", "d.yaml, line 2: 'count': input should be a valid integer, but got 2.5."),
        ("name: a\ncount: yes", "d.yaml, line 2: 'count': input should be a valid integer, but got 'yes'."),
        ("name: a\ncount: true", "d.yaml, line 2: 'count': input should be a valid integer, but got True."),
        ("name: a\nscale: true", "d.yaml, line 2: 'scale': input should be a valid number, but got True."),
        ("name: a\nscale: '1'", "d.yaml, line 2: 'scale': input should be a valid number, but got '1'."),
        ("name: a\nscale: .nan", "d.yaml, line 2: 'scale': input should be a finite number, but got nan."),
        ("name: a\nscale: -.inf", "d.yaml, line 2: 'scale': input should be a finite number, but got -inf."),
        ("name: a\nscale: 1:30", "d.yaml, line 2: 'scale': input should be a valid number, but got '1:30'."),
        ("name: 7", "d.yaml, line 1: 'name': input should be a valid string, but got 7."),
        ("name:", "d.yaml, line 1: 'name': input should be a valid string."),
        ("name: a\ncolour: gren", "d.yaml, line 2: 'colour' cannot be 'gren'; did you mean 'green'? Valid: green, red."),  # noqa: E501
        ("name: a\nshapes:\n- kind: circel\n  radius_mm: 1",
         "d.yaml, line 3: 'shapes.0.kind' cannot be 'circel'; did you mean 'circle'? Valid: circle, square."),
        ("name: a\nshapes:\n- radius_mm: 1",
         "d.yaml, line 3: the key 'kind' is missing in 'shapes.0'; add it. Valid: circle, square."),
        ("name: a\nshapes:\n- kind: circle\n  side_mm: 1",
         "d.yaml, line 4: unknown key 'side_mm' in 'shapes.0'; Valid: kind, radius_mm. (1 more findings)"),
        ("name: a\nshapes:\n- kind: square",
         "d.yaml, line 3: the key 'side_mm' is missing in 'shapes.0'; add it."),
        ("name: a\nsizes: {b: {kind: circle, radius: 1}}",
         "d.yaml, line 2: unknown key 'radius' in 'sizes.b'; did you mean 'radius_mm'? Valid: kind, radius_mm."),
        ("name: a\ncorner: [1, x]", "d.yaml, line 2: 'corner.1': input should be a valid number, but got 'x'."),
        ("5: a", "d.yaml, line 1: the key 5 is no text; correct the YAML there."),
        ("[a]: b", "d.yaml, line 1: the key ['a'] is no text; correct the YAML there."),
        ("- a\n- b", "d.yaml: a YAML mapping of keys to values was wanted, but it holds none."),
        ("", "d.yaml: a YAML mapping of keys to values was wanted, but it holds none."),
        ("# nothing", "d.yaml: a YAML mapping of keys to values was wanted, but it holds none."),
        ("name: [", "d.yaml, line 1: "),
        ("name: a\n\tcount: 1", "d.yaml, line 2: found character '\\t' that cannot start any token"),
        ("name: a\x00", "d.yaml: unacceptable character"),
        ("name: !!python/object:os.system x", "d.yaml, line 1: could not determine a constructor"),
        ("name: !!set {a, b}", "d.yaml: Object of type set"),
        ("name: a\ncount: !!int abc", "d.yaml, line 2: 'abc' is no number"),
        ("name: a\ncount: " + 5000 * "9", "d.yaml, line 2: 'count': input should be a valid integer"),
        ("name: " + 3000 * "[", "d.yaml: is nested too deeply"),
        ("name: &a [*a]", "d.yaml: is nested too deeply or within itself"),
        ("a: &a0 [x, x]\n" + "\n".join(f"b{i}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]" for i in range(9)),
         "d.yaml: holds more than 200,000 values"),
    ],
    ids=str,
)  # fmt: skip
def test_mistakes_are_one_sentence_with_place(text, complaint):
    with pytest.raises(RecipeError) as caught:
        read(text)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(RecipeError, match=r"none.yaml: cannot be read \(No such file or directory\)"):
        read_yaml(tmp_path / "none.yaml", Drawing, RecipeError)
    with pytest.raises(RecipeError, match=r"cannot be read \(Is a directory\)"):
        read_yaml(tmp_path, Drawing, RecipeError)
    (tmp_path / "latin.yaml").write_bytes(b"name: \xe9")
    with pytest.raises(RecipeError, match="is not UTF-8"):
        read_yaml(tmp_path / "latin.yaml", Drawing, RecipeError)


def test_a_byte_order_mark_and_aliases_are_read(tmp_path):
    text = "﻿name: a\nshapes:\n- &one {kind: circle, radius_mm: 1}\n- *one\n"
    (tmp_path / "d.yaml").write_text(text, encoding="utf-8")
    assert len(read_yaml(tmp_path / "d.yaml", Drawing, RecipeError).shapes) == 2


def test_the_line_of_a_value(tmp_path):
    path = tmp_path / "d.yaml"
    path.write_text("name: a\nshapes:\n- kind: circle\n\n- kind: square\n  side_mm: 1\n")
    assert line_of(path, ("name",)) == 1
    assert line_of(path, ("shapes",)) == 2
    assert line_of(path, ("shapes", 1)) == 5
    assert line_of(path, ("shapes", 1, "side_mm")) == 6
    assert line_of(path, ("shapes", 1, "nothing")) == 5


def test_an_alias_bomb_of_long_texts_is_refused(tmp_path):
    """80 kB that would take 3 GB."""
    path = tmp_path / "d.yaml"
    path.write_text(f"name: &a {'x' * 40_000}\nshapes: [{', '.join(['*a'] * 10_000)}]\n")
    with pytest.raises(RecipeError, match="holds more than 200,000 values with its aliases written out"):
        read_yaml(path, Drawing, RecipeError)


def test_a_file_that_nobody_wrote_is_refused_before_it_is_parsed(tmp_path):
    path = tmp_path / "d.yaml"
    path.write_text(
        "name: a\nsizes:\n" + "".join(f"  {i}: {{kind: circle, radius_mm: 1}}\n" for i in range(10_000))
    )
    with pytest.raises(RecipeError, match="MB, which no file of its kind has"):
        read_yaml(path, Drawing, RecipeError)


@pytest.mark.parametrize("text", ["1e3", "on", "0o7", "2024-01-31", "1_000", "null", "-", "x: y", " a"])
def test_texts_are_written_so_that_they_come_back(text):
    assert read(yaml_text({"name": text})).name == text
    assert yaml.safe_load(yaml_text({"name": text})) == {"name": text}

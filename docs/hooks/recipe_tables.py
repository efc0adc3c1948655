"""Generate the tables of all keys of recipes from the classes that validate them.

`python docs/hooks/recipe_tables.py` updates the page.
"""

import re
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from pisigma.files.setting import attribute_descriptions
from pisigma.simulation.errors.source import RegisteredSection
from pisigma.workflow.recipes.recipe import GeometricRecipe, HybridRecipe, InverseRecipe

PAGE = Path(__file__).parent.parent / "reference" / "recipes.md"
BEGIN, END = "<!-- begin: keys -->", "<!-- end: keys -->"
KINDS = (InverseRecipe, GeometricRecipe, HybridRecipe)

_PLAIN = {
    float: "number",
    int: "whole number",
    str: "text",
    bool: "true or false",
    type(None): "null",
    Any: "anything",
}


def tables() -> str:
    """Return all tables as Markdown, first the kinds of recipes, then their sections."""
    return "\n".join(_table(section) for section in _sections())


def page_with(text: str, new: str) -> str:
    """Return a page with the text between its markers replaced."""
    head, _, rest = text.partition(BEGIN)
    return f"{head}{BEGIN}\n\n{new}\n{END}{rest.partition(END)[2]}"


def _sections() -> list[type[BaseModel]]:
    """Return the kinds of recipes and all sections that they refer to, each once."""
    found: list[type[BaseModel]] = list(KINDS)
    for section in found:
        for field in section.model_fields.values():
            found += [inner for inner in _inner(field.annotation) if inner not in found]
    return found


def _inner(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(_closed(annotation)):
        yield from _inner(argument)


def _closed(annotation: Any) -> Any:
    """Return the annotation, or the union of all sections of a registry that it names."""
    for choice in getattr(annotation, "__metadata__", ()):
        if isinstance(choice, RegisteredSection):
            return typing.Union[tuple(choice.registry.values())]  # noqa: UP007
    return annotation


def _table(section: type[BaseModel]) -> str:
    doc = attribute_descriptions(section)
    lines = [f"### {_name(section)}", "", _cell(_summary(section)), ""]
    lines += ["| key | value | default | meaning |", "|---|---|---|---|"]
    for name, field in section.model_fields.items():
        cells = (f"`{name}`", _type(field.annotation), _default(field), _cell(doc.get(name, "")))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def _name(section: type[BaseModel]) -> str:
    """Return the title of a section: its `kind` or `method`, otherwise its class."""
    for key in ("kind", "method"):
        if key in section.model_fields:
            values = typing.get_args(section.model_fields[key].annotation)
            if len(values) == 1:
                return f"{key}: {values[0]}"
    words = re.sub(r"(Section|Figures|Document)$", "", section.__name__)
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", words).lower()


def _summary(section: type[BaseModel]) -> str:
    text = (section.__doc__ or "").strip()
    return re.split(r"\n\s*(?:Attributes|Source):", text)[0].replace("``", "`")


def _type(annotation: Any) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        name = _name(annotation)
        return f"[{name}](#{re.sub(r'[^a-z0-9_]+', '-', name.lower()).strip('-')})"
    if origin is typing.Annotated:
        closed = _closed(annotation)
        return _type(arguments[0] if closed is annotation else closed)
    if origin is typing.Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_type(argument) for argument in arguments))
    if origin is dict:
        return f"mapping of name to {_type(arguments[1])}"
    if origin is list or (origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis):
        return f"list of {_type(arguments[0])}"
    if origin is tuple:
        return f"list of {len(arguments)}: {_type(arguments[0])}"
    raise TypeError(f"{annotation} has no words yet; add them to docs/hooks/recipe_tables.py.")


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return ""
    if isinstance(value, BaseModel):
        stated = value.model_dump(exclude_defaults=True, exclude_none=True)
        return f"`{stated}`" if stated else "its defaults"
    if value is None or value in ({}, (), ""):
        return "none"
    return f"`{list(value)}`" if isinstance(value, tuple) else f"`{value}`"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page_with(PAGE.read_text(encoding="utf-8"), tables()), encoding="utf-8")

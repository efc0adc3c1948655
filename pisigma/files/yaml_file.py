"""Read YAML files as validated, typed documents; every error states file, line and key."""

import json
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pisigma.files.errors import PisigmaError, Place, choice_remedy
from pisigma.files.input_file import read_text

MAX_BYTES = 2**18
"""Largest size of a YAML file [bytes]; reading such a file takes two seconds."""
MAX_VALUES = 200_000
"""Largest number of values in a file with expanded aliases; `CHARACTERS_PER_VALUE` characters count as one value."""
CHARACTERS_PER_VALUE = 64
_SAFE_DEPTH = 2000
"""Nesting depth that libyaml, which does not check its stack, certainly parses without overflow."""


class Section(BaseModel):
    """Base class of all sections of files that people write: frozen, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StoredFigures(Section):
    """Base class of figures whose keys in files may have other names than their fields: `Field(alias=KEY)`."""

    model_config = ConfigDict(populate_by_name=True)


Seed = Annotated[int, Field(ge=0, lt=2**63)]
"""Seed of a random number generator."""
MAX_POSES = 100_000
Count = Annotated[int, Field(ge=1, le=MAX_POSES)]
"""Number of poses or rows to simulate; more would take gigabytes."""


Document = TypeVar("Document", bound=BaseModel)
_Path = tuple[str | int, ...]
"""Keys, indices and union tags that lead to a place, as in pydantic's findings."""
_Schema = dict[str, Any]


class PlainLoader(yaml.SafeLoader):
    """YAML's safe loader with the plain scalars of YAML 1.2, which rejects duplicate keys.

    YAML 1.1 reads `010` as 8, `1:30` as 90, `no` as false and `1e-3` as text. Here they are 10, text, text
    and 0.001.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


class _CompiledLoader(yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader):  # type: ignore[misc]
    """`PlainLoader` on libyaml, which is ten times as fast."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


def _construct_mapping(loader: Any, node: yaml.MappingNode) -> dict[Any, Any]:
    mapping: dict[Any, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)
        mark = key_node.start_mark
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} is not text", mark)
        if key in mapping:
            raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' appears twice", mark)
        mapping[key] = loader.construct_object(value_node, deep=True)
    return mapping


def _construct_number(loader: Any, node: yaml.ScalarNode) -> int | float:
    text = str(node.value)
    try:
        return float(text.replace(".inf", "inf").replace(".nan", "nan").lower())
    except ValueError:
        problem = f"'{text}' is not a number"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


def _construct_integer(loader: Any, node: yaml.ScalarNode) -> int | float:
    number = _construct_number(loader, node)
    return int(node.value) if re.fullmatch(r"[-+]?[0-9]{1,400}", node.value) else number


for _loader in (PlainLoader, _CompiledLoader):
    _loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)
    _loader.add_constructor("tag:yaml.org,2002:int", _construct_integer)
    _loader.add_constructor("tag:yaml.org,2002:float", _construct_number)
for _tag, _pattern, _first in (
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    ("int", r"^[-+]?[0-9]+$", list("-+0123456789")),
    ("float", r"^[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$", list("-+.0123456789")),
    ("float", r"^(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$", list("-+.")),
):
    for _loader in (PlainLoader, _CompiledLoader):
        _loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)


def parse_plain_yaml(text: str, error: type[PisigmaError], source: str) -> Any:
    """Parse YAML text as plain values, for documents whose format must first be determined.

    Raises:
        error: the text is not valid YAML, or has too many values.
    """
    return _load(text, error, source)[1]


def read_yaml(path: str | os.PathLike[str], document: type[Document], error: type[PisigmaError]) -> Document:
    """Read a YAML file as a `document`.

    Args:
        path: the file.
        document: pydantic model of the file.
        error: class of the exception to raise, such as `RecipeError`.

    Raises:
        error: the file is missing, is not valid YAML, or does not fit the model; its `file`, `line` and `column` (the
            key, such as "rows.2.a_mm") locate the fault.
    """
    return parse_yaml(read_text(path, error, "YAML", MAX_BYTES), document, error, source=str(path))


def parse_yaml(text: str, document: type[Document], error: type[PisigmaError], source: str) -> Document:
    """Read YAML text as a `document`; `source` is its name in errors. See `read_yaml`.

    Types are strict: a string is not accepted as a number, nor a number as a string.
    """
    node, content = _load(text, error, source)
    if node is None or not isinstance(content, dict):
        raise error(expected="a YAML mapping of keys to values", at=Place(source))
    try:
        # Validated as JSON, because strict validation of Python objects expects tuples where YAML has lists.
        return document.model_validate_json(json.dumps(content), strict=True)
    except TypeError as problem:
        remedy = "write numbers, texts, lists and mappings without tags"
        raise error(str(problem), expected="plain values", at=Place(source), remedy=remedy) from None
    except ValidationError as problem:
        raise _error_of(problem, node, document, error, source) from None


def place_of_key(path: str | os.PathLike[str], keys: _Path) -> Place:
    """Return the place of the value under `keys` in a YAML file, or of the innermost section that exists.

    It is used for values that are checked against something other than the format of the file, such as a robot.
    """
    node, _ = _load(read_text(path, PisigmaError, "YAML", MAX_BYTES), PisigmaError, str(path))
    return Place(path, _locate(node, keys)[0] if node else 1, _dotted(keys))


def _load(text: str, error: type[PisigmaError], source: str) -> tuple[yaml.Node | None, Any]:
    """Return the root node, which contains the line numbers, and the document as plain values."""
    try:
        loader, node = _composed(text)
        if node is not None and _count(node, {}) > MAX_VALUES:
            raise error(
                f"the file has more than {MAX_VALUES:,} values with its aliases expanded",
                expected=f"{MAX_VALUES} values or fewer",
                at=Place(source),
            )
        return node, loader.construct_document(node) if node else None
    except yaml.YAMLError as problem:
        mark = getattr(problem, "problem_mark", None)
        what = getattr(problem, "problem", None) or " ".join(str(problem).split())
        at = Place(source, mark.line + 1 if mark else None)
        raise error(what, expected="valid YAML", at=at, remedy="correct the YAML there") from None
    except RecursionError:
        what = "the document is nested too deeply or contains itself"
        raise error(what, expected="valid YAML", at=Place(source), remedy="correct the YAML") from None


def _composed(text: str) -> tuple[Any, yaml.Node | None]:
    """Return a loader and the root node; the loader uses libyaml unless that might overflow its stack or fails."""
    longest_line = max(map(len, text.splitlines()), default=0)
    if text.count("[") + text.count("{") + 2 * longest_line < _SAFE_DEPTH:
        with suppress(yaml.YAMLError):
            return (loader := _CompiledLoader(text)), loader.get_single_node()
    return (plain := PlainLoader(text)), plain.get_single_node()


def _count(node: yaml.Node, known: dict[int, int]) -> int:
    """Count the values at and below a node; a long text counts as several values, an alias once per use."""
    if id(node) not in known:
        children: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            children = [child for pair in node.value for child in pair]
        elif isinstance(node, yaml.SequenceNode):
            children = node.value
        characters = len(node.value) if isinstance(node, yaml.ScalarNode) else 0
        own = 1 + characters // CHARACTERS_PER_VALUE
        known[id(node)] = own + sum(_count(child, known) for child in children)
    return known[id(node)]


def _error_of(
    problem: ValidationError,
    node: yaml.Node,
    document: type[BaseModel],
    error: type[PisigmaError],
    source: str,
) -> PisigmaError:
    """Return an error for one finding of pydantic: an unknown key if there is one, otherwise the first finding."""
    errors = problem.errors()
    first = next((item for item in errors if item["type"] == "extra_forbidden"), errors[0])
    found = _error_at(first, node, document, error, source)
    others = len(errors) - 1
    if not others:
        return found
    return found.with_text_after(f" {others} more mistake{'s' if others > 1 else ''} in this file.")


def _error_at(
    finding: Any, node: yaml.Node, document: type[BaseModel], error: type[PisigmaError], source: str
) -> PisigmaError:
    """Return an error for one finding of pydantic."""
    path: _Path = finding["loc"]
    line, keys = _locate(node, path)
    context, value = finding.get("ctx", {}), finding["input"]
    if finding["type"] == "extra_forbidden":
        hint = choice_remedy(str(keys[-1]), valid_keys(document, path[:-1]))
        at = Place(source, line, _dotted(keys))
        return error(f"unknown key '{keys[-1]}'", value=keys[-1], at=at, remedy=hint)
    if finding["type"] == "missing":
        at = Place(source, line, _dotted((*keys, path[-1])))
        what = "an entry of the list" if isinstance(path[-1], int) else f"the key '{path[-1]}'"
        return error(f"{what} is missing", expected="a value", at=at, remedy="add it")
    if finding["type"].startswith("union_tag"):
        tag = str(context["discriminator"]).strip("'()")
        path = (*path, tag)
        if finding["type"] == "union_tag_not_found":
            at, choices = Place(source, line, _dotted((*keys, tag))), allowed_texts(document, path)
            remedy = f"add it. Valid: {', '.join(choices)}."
            return error(f"the key '{tag}' is missing", expected="a value", at=at, remedy=remedy)
        line, keys = _locate(node, path)
        value = context["tag"]
    at = Place(source, line, _dotted(keys) or None)
    if isinstance(cause := context.get("error"), PisigmaError):
        return cause.with_place(at, error)
    if finding["type"] in ("union_tag_invalid", "literal_error") and (texts := allowed_texts(document, path)):
        return error(f"unknown value '{value}'", value=value, at=at, remedy=choice_remedy(str(value), texts))
    value = value if isinstance(value, str | int | float) else None
    message = finding["msg"].removeprefix("Value error, ").rstrip(".")
    if message.startswith("Input should be "):
        expected = message.removeprefix("Input should be ")
        is_bound = expected.startswith(("greater", "less"))
        return error(expected=f"a number {expected}" if is_bound else expected, value=value, at=at)
    problem, _, remedy = f"{message[:1].lower()}{message[1:]}".partition("; ")
    problem = f"{problem}, got {value!r}" if value is not None else problem
    return error(problem, value=value, at=at, remedy=remedy)


def _dotted(keys: Iterable[str | int]) -> str:
    """Return keys joined by dots, as the column of a `Place`."""
    return ".".join(map(str, keys))


def _locate(node: yaml.Node, path: _Path) -> tuple[int, list[str | int]]:
    """Follow a validation path through the YAML nodes as far as it leads; return the line and the keys followed.

    Parts of the path that are not keys (tags of discriminated unions) are skipped.
    """
    line = node.start_mark.line + 1
    keys: list[str | int] = []
    for part in path:
        if isinstance(node, yaml.MappingNode):
            entry = next(((k, v) for k, v in node.value if k.value == part), None)
            if entry is None:
                continue
            line, node = entry[0].start_mark.line + 1, entry[1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line + 1
        else:
            continue
        keys.append(part)
    return line, keys


def valid_keys(document: type[BaseModel], path: _Path) -> set[str]:
    """Return the valid keys of the document's section at the end of a validation path."""
    return {key for schema in _follow(document, path) for key in schema.get("properties", {})}


def allowed_texts(document: type[BaseModel], path: _Path) -> list[str]:
    """Return the sorted texts that are allowed at the end of a validation path; empty if any text is allowed."""
    texts: set[str] = set()
    for schema in _follow(document, path):
        values = [schema["const"]] if "const" in schema else schema.get("enum", [])
        texts |= {value for value in values if isinstance(value, str)}
    return sorted(texts)


def _follow(document: type[BaseModel], path: _Path) -> list[_Schema]:
    """Return the plain schemas at the end of a validation path of keys, indices and union tags."""
    schema = document.model_json_schema()
    definitions = schema.get("$defs", {})
    nodes = _alternatives([schema], definitions)
    for part in path:
        following: list[_Schema] = []
        for candidate in nodes:
            if part in candidate.get("properties", {}):
                following.append(candidate["properties"][part])
            elif isinstance(part, int) and "prefixItems" in candidate:
                following.append(candidate["prefixItems"][part])
            elif isinstance(part, int) and "items" in candidate:
                following.append(candidate["items"])
            elif isinstance(candidate.get("additionalProperties"), dict):
                following.append(candidate["additionalProperties"])
        if following:
            nodes = _alternatives(following, definitions)
        else:  # the key is the tag of a union: keep the alternative with that tag
            nodes = [candidate for candidate in nodes if part in _tags(candidate)] or nodes
    return nodes


def _tags(schema: _Schema) -> list[Any]:
    return [value.get("const") for value in schema.get("properties", {}).values()]


def _alternatives(nodes: list[_Schema], definitions: dict[str, _Schema]) -> list[_Schema]:
    """Resolve references and unions into plain schemas."""
    plain: list[_Schema] = []
    open_nodes = list(nodes)
    while open_nodes:
        schema = open_nodes.pop()
        if "$ref" in schema:
            open_nodes.append(definitions[schema["$ref"].rsplit("/", 1)[-1]])
        elif "anyOf" in schema or "oneOf" in schema:
            open_nodes += schema.get("anyOf", []) + schema.get("oneOf", [])
        else:
            plain.append(schema)
    return plain

"""Reading YAML files into validated, typed documents, with file and line in every complaint."""

import os
import re
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from pisigma.errors import PisigmaError, nearest_choice


class Section(BaseModel):
    """Base of every section of a file that people write: frozen, and no key that it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Document = TypeVar("Document", bound=BaseModel)
_Path = tuple[str | int, ...]


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML's safe loader, refusing a key that stands twice and reading 1e-3 as a number."""


def _construct_mapping(loader: _UniqueKeyLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    mapping: dict[Any, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)  # type: ignore[no-untyped-call]
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} is no text", key_node.start_mark)
        if key in mapping:
            raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' stands twice", key_node.start_mark)
        mapping[key] = loader.construct_object(value_node, deep=True)  # type: ignore[no-untyped-call]
    return mapping


_UniqueKeyLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)
# YAML 1.1 wants a dot in a float; people write 1e-3.
_UniqueKeyLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_yaml(path: str | os.PathLike[str], document: type[Document], error: type[PisigmaError]) -> Document:
    """Read a YAML file as a `document`.

    Args:
        path: the file.
        document: the pydantic model that says what the file may hold.
        error: the exception to raise, so that callers can tell a bad recipe from a bad robot.

    Raises:
        error: the file is missing, no YAML, or does not fit; the message names file, line and key.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror}); check the path.") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not UTF-8 text; a YAML file was wanted.") from None
    return parse_yaml(text, document, error, source=str(path))


def parse_yaml(text: str, document: type[Document], error: type[PisigmaError], source: str) -> Document:
    """Read YAML text as a `document`; `source` is what complaints call it. See `read_yaml`."""
    loader = _UniqueKeyLoader(text)
    try:
        node = loader.get_single_node()  # type: ignore[no-untyped-call]
        content = loader.construct_document(node) if node else None  # type: ignore[no-untyped-call]
    except yaml.YAMLError as problem:
        mark = getattr(problem, "problem_mark", None)
        place = f"{source}, line {mark.line + 1}" if mark else source
        what = getattr(problem, "problem", None) or str(problem).splitlines()[0]
        raise error(f"{place}: {what}; correct the YAML there.") from None
    if not isinstance(content, dict):
        raise error(f"{source}: a YAML mapping of keys to values was wanted, but it holds none.")
    try:
        return document.model_validate(content)
    except ValidationError as problem:
        raise error(_complaint(problem, node, document, source)) from None


def _complaint(problem: ValidationError, node: yaml.Node, document: type[BaseModel], source: str) -> str:
    """Say in one sentence what the first finding is and where it stands."""
    found = problem.errors()
    first = next((item for item in found if item["type"] == "extra_forbidden"), found[0])
    path: _Path = first["loc"]
    line, keys = _locate(node, path)
    key = ".".join(str(part) for part in keys) or "the file"
    more = f" ({len(found) - 1} more findings)" if len(found) > 1 else ""
    place = f"{source}, line {line}"
    if first["type"] == "extra_forbidden":
        choices = _valid_keys(document, path[:-1])
        return f"{place}: unknown key '{keys[-1]}' in '{key}'; {nearest_choice(str(keys[-1]), choices)}{more}"
    if first["type"] == "missing":
        return f"{place}: the key '{path[-1]}' is missing in '{key}'; add it.{more}"
    message = first["msg"].removeprefix("Value error, ")
    given = first["input"]
    came = f", but got {given!r}" if isinstance(given, str | int | float | bool) else ""
    return f"{place}: '{key}': {message[:1].lower()}{message[1:]}{came}.{more}".replace("..", ".")


def _locate(node: yaml.Node, path: _Path) -> tuple[int, list[str | int]]:
    """Follow a validation path through the YAML nodes as far as it goes; give the line and the keys followed.

    Parts of the path that are no keys (tags of discriminated unions) are passed over.
    """
    line = node.start_mark.line + 1
    keys: list[str | int] = []
    for part in path:
        if isinstance(node, yaml.MappingNode):
            found = next(((k, v) for k, v in node.value if k.value == part), None)
            if found is None:
                continue
            line, node = found[0].start_mark.line + 1, found[1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line + 1
        else:
            continue
        keys.append(part)
    return line, keys


def _valid_keys(document: Any, path: _Path) -> set[str]:
    """Field names that are valid where `path` leads, found by walking the JSON schema."""
    schema = document.model_json_schema()
    definitions = schema.get("$defs", {})
    nodes = [schema]
    for part in path:
        following = []
        for candidate in _alternatives(nodes, definitions):
            properties = candidate.get("properties", {})
            if part in properties:
                following.append(properties[part])
            elif isinstance(part, int) and ("items" in candidate or "prefixItems" in candidate):
                following.append(candidate.get("items") or candidate["prefixItems"][part])
            elif isinstance(candidate.get("additionalProperties"), dict):
                following.append(candidate["additionalProperties"])
        if following:
            nodes = following
        else:  # a union's tag: keep the alternative of that tag
            tagged = [c for c in _alternatives(nodes, definitions) if part in _tags(c)]
            nodes = tagged or nodes
    keys: set[str] = set()
    for candidate in _alternatives(nodes, definitions):
        keys |= set(candidate.get("properties", {}))
    return keys


def _tags(schema: dict[str, Any]) -> set[Any]:
    return {value.get("const") for value in schema.get("properties", {}).values()}


def _alternatives(nodes: list[dict[str, Any]], definitions: dict[str, Any]) -> list[dict[str, Any]]:
    """Resolve references and unions into the plain schemas that they stand for."""
    plain: list[dict[str, Any]] = []
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

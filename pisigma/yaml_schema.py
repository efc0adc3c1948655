"""What a typed document allows at a place, found by walking its JSON schema."""

from typing import Any

from pydantic import BaseModel

_Path = tuple[str | int, ...]
_Schema = dict[str, Any]


def valid_keys(document: type[BaseModel], path: _Path) -> set[str]:
    """Keys that are valid where a validation path leads."""
    return {key for schema in _follow(document, path) for key in schema.get("properties", {})}


def allowed_texts(document: type[BaseModel], path: _Path) -> list[str]:
    """Texts that are allowed where a validation path leads, sorted; none where any text is."""
    found: set[str] = set()
    for schema in _follow(document, path):
        values = [schema["const"]] if "const" in schema else schema.get("enum", [])
        found |= {value for value in values if isinstance(value, str)}
    return sorted(found)


def _follow(document: type[BaseModel], path: _Path) -> list[_Schema]:
    """Plain schemas at the end of a validation path, which holds keys, indices and tags of unions."""
    schema = document.model_json_schema()
    definitions = schema.get("$defs", {})
    nodes = _alternatives([schema], definitions)
    for part in path:
        following: list[_Schema] = []
        for candidate in nodes:
            if part in candidate.get("properties", {}):
                following.append(candidate["properties"][part])
            elif isinstance(part, int) and ("items" in candidate or "prefixItems" in candidate):
                following.append(candidate.get("items") or candidate["prefixItems"][part])
            elif isinstance(candidate.get("additionalProperties"), dict):
                following.append(candidate["additionalProperties"])
        if following:
            nodes = _alternatives(following, definitions)
        else:  # a union's tag: keep the alternative of that tag
            nodes = [candidate for candidate in nodes if part in _tags(candidate)] or nodes
    return nodes


def _tags(schema: _Schema) -> list[Any]:
    return [value.get("const") for value in schema.get("properties", {}).values()]


def _alternatives(nodes: list[_Schema], definitions: dict[str, _Schema]) -> list[_Schema]:
    """Resolve references and unions into the plain schemas that they stand for."""
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

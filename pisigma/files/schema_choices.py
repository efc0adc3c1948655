"""Find the valid keys and texts at a place of a pydantic model, for errors that list them."""

from typing import Any

from pydantic import BaseModel

SchemaPath = tuple[str | int, ...]
"""Keys, indices and union tags that lead to a place, as in pydantic's findings."""

_Schema = dict[str, Any]


def valid_keys(document: type[BaseModel], path: SchemaPath) -> set[str]:
    """Return the valid keys of the document's section at the end of a validation path."""
    return {key for schema in _follow(document, path) for key in schema.get("properties", {})}


def allowed_texts(document: type[BaseModel], path: SchemaPath) -> list[str]:
    """Return the sorted texts that are allowed at the end of a validation path; empty if any text is allowed."""
    texts: set[str] = set()
    for schema in _follow(document, path):
        values = [schema["const"]] if "const" in schema else schema.get("enum", [])
        texts |= {value for value in values if isinstance(value, str)}
    return sorted(texts)


def _follow(document: type[BaseModel], path: SchemaPath) -> list[_Schema]:
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

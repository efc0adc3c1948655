"""Reading YAML files into validated, typed documents, with file and line in every complaint."""

import functools
import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, Union

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import CoreSchema, core_schema

from pisigma.files.errors import PisigmaError, nearest_choice
from pisigma.files.input_file import read_text

MOST_BYTES = 2**18
"""Of a file that people write: reading it takes two seconds."""
MOST_VALUES = 200_000
"""Values that a file may hold, aliases written out; `LETTERS_OF_VALUE` of a text count as one."""
LETTERS_OF_VALUE = 64
SAFE_DEPTH = 2000
"""Nested lists and mappings for which the stack of libyaml, which does not watch it, surely suffices."""


class Section(BaseModel):
    """Base of every section of a file that people write: frozen, and no key that it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Seed = Annotated[int, Field(ge=0, lt=2**63)]
"""Of a generator of random numbers."""
MOST_POSES = 100_000
Count = Annotated[int, Field(ge=1, le=MOST_POSES)]
"""Of poses or rows to simulate; more would take gigabytes."""


@dataclass(frozen=True, eq=False)
class OneOf:
    """Annotates a value as a section of a registry, chosen by its `kind`; sections may be registered later.

    `Annotated[AbstractErrorSource, OneOf(ERROR_SOURCES)]` reads `{kind: encoder, ...}` as the section that is
    registered as "encoder", and its complaints list what is registered then.

    Attributes:
        registry: two sections or more by their kinds.
    """

    registry: Mapping[str, type[Section]]

    def _sections(self) -> Any:  # a TypeAdapter, which beartype does not take for a type
        return _one_of(tuple(self.registry.values()))

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """How pydantic reads the value: by the registry as it is when it reads."""
        plain = core_schema.no_info_plain_validator_function
        return core_schema.json_or_python_schema(plain(self._from_json), plain(self._from_python))

    def _from_json(self, value: Any) -> Any:
        return self._sections().validate_json(json.dumps(value), strict=True)

    def _from_python(self, value: Any) -> Any:
        return value if isinstance(value, Section) else self._sections().validate_python(value)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """What may be written there now."""
        return handler(self._sections().core_schema)


@functools.lru_cache(maxsize=64)
def _one_of(sections: tuple[type[Section], ...]) -> Any:
    any_of: Any = Annotated[Union[sections], Field(discriminator="kind")]  # noqa: UP007
    return TypeAdapter(any_of)


Document = TypeVar("Document", bound=BaseModel)
_Path = tuple[str | int, ...]


class _PlainLoader(yaml.SafeLoader):
    """YAML's safe loader with the plain scalars of YAML 1.2, refusing a key that stands twice.

    YAML 1.1 reads `010` as 8, `1:30` as 90, `no` as false and `1e-3` as text. Here they are 10, text, text
    and 0.001.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


class _CompiledLoader(yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader):  # type: ignore[misc]
    """The same by libyaml, ten times as fast."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


def _construct_mapping(loader: Any, node: yaml.MappingNode) -> dict[Any, Any]:
    mapping: dict[Any, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)
        mark = key_node.start_mark
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} is no text", mark)
        if key in mapping:
            raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' stands twice", mark)
        mapping[key] = loader.construct_object(value_node, deep=True)
    return mapping


def _construct_number(loader: Any, node: yaml.ScalarNode) -> int | float:
    text = str(node.value)
    try:
        return float(text.replace(".inf", "inf").replace(".nan", "nan").lower())
    except ValueError:
        problem = f"'{text}' is no number"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


def _construct_integer(loader: Any, node: yaml.ScalarNode) -> int | float:
    number = _construct_number(loader, node)
    return int(node.value) if re.fullmatch(r"[-+]?[0-9]{1,400}", node.value) else number


for _loader in (_PlainLoader, _CompiledLoader):
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
    for _loader in (_PlainLoader, _CompiledLoader):
        _loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)


class _QuotingDumper(yaml.SafeDumper):
    """YAML's safe dumper, which puts texts into quotes that read as something else by YAML 1.1 or 1.2."""


for _letter, _resolvers in _PlainLoader.yaml_implicit_resolvers.items():
    for _tag, _regexp in _resolvers:
        _QuotingDumper.add_implicit_resolver(_tag, _regexp, [_letter])


def yaml_text(content: dict[str, Any]) -> str:
    """Give plain values as YAML text that this and other readers read back as they are."""
    text: str = yaml.dump(content, Dumper=_QuotingDumper, sort_keys=False, allow_unicode=True)
    return text


def plain_content(text: str, error: type[PisigmaError], source: str) -> Any:
    """Give what YAML text holds, as plain values; for documents whose form has to be looked at first.

    Raises:
        error: it is no YAML, or holds too much.
    """
    return _load(text, error, source)[1]


def read_yaml(path: str | os.PathLike[str], document: type[Document], error: type[PisigmaError]) -> Document:
    """Read a YAML file as a `document`.

    Args:
        path: the file.
        document: the pydantic model that says what the file may hold.
        error: the exception to raise, so that callers can tell a bad recipe from a bad robot.

    Raises:
        error: the file is missing, no YAML, or does not fit; the message names file, line and key.
    """
    return parse_yaml(read_text(path, error, "YAML", MOST_BYTES), document, error, source=str(path))


def parse_yaml(text: str, document: type[Document], error: type[PisigmaError], source: str) -> Document:
    """Read YAML text as a `document`; `source` is what complaints call it. See `read_yaml`.

    Types are taken strictly: a text is no number, and a number no text.
    """
    node, content = _load(text, error, source)
    if node is None or not isinstance(content, dict):
        raise error(f"{source}: a YAML mapping of keys to values was wanted, but it holds none.")
    try:
        # By way of JSON, because strict validation of Python objects wants tuples where YAML has lists.
        return document.model_validate_json(json.dumps(content), strict=True)
    except TypeError as problem:
        raise error(f"{source}: {problem}; write numbers, texts, lists and mappings without tags.") from None
    except ValidationError as problem:
        raise error(_complaint(problem, node, document, source)) from None


def line_of(path: str | os.PathLike[str], keys: _Path) -> int:
    """Line of a YAML file, counted from 1, on which the value under `keys` stands; as near as the keys lead.

    For complaints about values that only other things than the file's form can judge.
    """
    node, _ = _load(read_text(path, PisigmaError, "YAML", MOST_BYTES), PisigmaError, str(path))
    return _locate(node, keys)[0] if node else 1


def _load(text: str, error: type[PisigmaError], source: str) -> tuple[yaml.Node | None, Any]:
    """The YAML nodes, for places, and what they hold."""
    try:
        loader, node = _composed(text)
        if node is not None and _count(node, {}) > MOST_VALUES:
            raise error(
                f"{source}: holds more than {MOST_VALUES:,} values with its aliases written out; fewer were wanted."
            )
        return node, loader.construct_document(node) if node else None
    except yaml.YAMLError as problem:
        mark = getattr(problem, "problem_mark", None)
        place = f"{source}, line {mark.line + 1}" if mark else source
        what = getattr(problem, "problem", None) or " ".join(str(problem).split())
        raise error(f"{place}: {what}; correct the YAML there.") from None
    except RecursionError:
        raise error(f"{source}: is nested too deeply or within itself; correct the YAML.") from None


def _composed(text: str) -> tuple[Any, yaml.Node | None]:
    """The loader and its nodes: libyaml's, but where it could overflow its stack, or has a complaint less plain."""
    longest_line = max(map(len, text.splitlines()), default=0)
    if text.count("[") + text.count("{") + 2 * longest_line < SAFE_DEPTH:
        with suppress(yaml.YAMLError):
            return (loader := _CompiledLoader(text)), loader.get_single_node()
    return (plain := _PlainLoader(text)), plain.get_single_node()


def _count(node: yaml.Node, known: dict[int, int]) -> int:
    """Number of values at and below a node, long texts as several, and aliases wherever they stand."""
    if id(node) not in known:
        children: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            children = [child for pair in node.value for child in pair]
        elif isinstance(node, yaml.SequenceNode):
            children = node.value
        letters = len(node.value) if isinstance(node, yaml.ScalarNode) else 0
        known[id(node)] = 1 + letters // LETTERS_OF_VALUE + sum(_count(child, known) for child in children)
    return known[id(node)]


def _complaint(problem: ValidationError, node: yaml.Node, document: type[BaseModel], source: str) -> str:
    """Say in one sentence what the first finding is and where it stands."""
    errors = problem.errors()
    first = next((item for item in errors if item["type"] == "extra_forbidden"), errors[0])
    path: _Path = first["loc"]
    line, keys = _locate(node, path)
    key = ".".join(str(part) for part in keys) or "the file"
    where = f"{source}, line {line}"
    more = f" ({len(errors) - 1} more findings)" if len(errors) > 1 else ""
    context = first.get("ctx", {})
    if first["type"] == "extra_forbidden":
        section = ".".join(str(part) for part in keys[:-1]) or "the file"
        hint = nearest_choice(str(keys[-1]), valid_keys(document, path[:-1]))
        return f"{where}: unknown key '{keys[-1]}' in '{section}'; {hint}{more}"
    if first["type"] == "missing":
        return f"{where}: the key '{path[-1]}' is missing in '{key}'; add it.{more}"
    if first["type"] == "union_tag_not_found":
        tag = str(context["discriminator"]).strip("'()")
        choices = ", ".join(allowed_texts(document, (*path, tag)))
        return f"{where}: the key '{tag}' is missing in '{key}'; add it. Valid: {choices}.{more}"
    if first["type"] == "union_tag_invalid":
        path = (*path, str(context["discriminator"]).strip("'()"))
        line, keys = _locate(node, path)
        return _wrong_choice(source, line, keys, str(context["tag"]), allowed_texts(document, path)) + more
    if first["type"] == "literal_error" and (texts := allowed_texts(document, path)):
        return _wrong_choice(source, line, keys, str(first["input"]), texts) + more
    message = first["msg"].removeprefix("Value error, ").rstrip(".")
    value = first["input"]
    came = f", but got {value!r}" if isinstance(value, str | int | float) else ""
    return f"{where}: '{key}': {message[:1].lower()}{message[1:]}{came}.{more}"


def _wrong_choice(source: str, line: int, keys: list[str | int], stated: str, choices: list[str]) -> str:
    key = ".".join(str(part) for part in keys)
    return f"{source}, line {line}: '{key}' cannot be '{stated}'; {nearest_choice(stated, choices)}"


def _locate(node: yaml.Node, path: _Path) -> tuple[int, list[str | int]]:
    """Follow a validation path through the YAML nodes as far as it goes; give the line and the keys followed.

    Parts of the path that are no keys (tags of discriminated unions) are passed over.
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


_Schema = dict[str, Any]


def valid_keys(document: type[BaseModel], path: _Path) -> set[str]:
    """Keys that are valid where a validation path leads."""
    return {key for schema in _follow(document, path) for key in schema.get("properties", {})}


def allowed_texts(document: type[BaseModel], path: _Path) -> list[str]:
    """Texts that are allowed where a validation path leads, sorted; none where any text is."""
    texts: set[str] = set()
    for schema in _follow(document, path):
        values = [schema["const"]] if "const" in schema else schema.get("enum", [])
        texts |= {value for value in values if isinstance(value, str)}
    return sorted(texts)


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
            elif isinstance(part, int) and "prefixItems" in candidate:
                following.append(candidate["prefixItems"][part])
            elif isinstance(part, int) and "items" in candidate:
                following.append(candidate["items"])
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

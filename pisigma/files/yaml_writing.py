"""Write values as YAML text, and change single values of such a text while keeping its comments and order."""

import math
import re
from collections.abc import Sequence
from typing import Any

import yaml

from pisigma.files.errors import PisigmaError, Place
from pisigma.files.yaml_file import PlainLoader, parse_plain_yaml

Keys = Sequence[str | int]
_INDENT = 2
"""Number of spaces by which the first key of an empty section is indented."""
_COMMENTS = re.compile(r"[^\n]*\n(?:[ \t]*(?:#[^\n]*)?\n)*")
"""Pattern of the end of a line with the blank lines and comments after it."""


class _QuotingDumper(yaml.SafeDumper):
    """YAML's safe dumper, which quotes texts that YAML 1.1 or 1.2 would read as something else."""


for _letter, _resolvers in PlainLoader.yaml_implicit_resolvers.items():
    for _tag, _regexp in _resolvers:
        _QuotingDumper.add_implicit_resolver(_tag, _regexp, [_letter])


def yaml_text(content: Any, in_one_line: bool = False) -> str:
    """Format plain values as YAML text that any YAML 1.1 or 1.2 reader restores unchanged."""
    style: dict[str, Any] = {"default_flow_style": True, "width": math.inf} if in_one_line else {}
    text: str = yaml.dump(content, Dumper=_QuotingDumper, sort_keys=False, allow_unicode=True, **style)
    return text.removesuffix("\n").removesuffix("\n...") if in_one_line else text


def with_changed_value(text: str, keys: Keys, value: Any, source: str) -> str:
    """Return the text of a YAML file after a change of one value.

    A missing key is added before the comment that states its default ("# folds: 5"), or else at the end of its section.
    Only a collection in braces loses the comments inside it.

    Args:
        text: a valid YAML document.
        keys: keys from the outermost section to the value; a number counts the items of a list, and the number after
            the last item appends one.
        value: plain value. None removes the key, and nested sections that become empty.
        source: name of the file in errors.

    Raises:
        PisigmaError: the text is written in such a way that this value cannot be changed alone.
    """
    text = text if text.endswith("\n") else f"{text}\n"
    before = parse_plain_yaml(text, PisigmaError, source)
    wanted = _changed(before, keys, value)
    if wanted == before:
        return text
    changed = _edited(text, keys, value, wanted)
    if parse_plain_yaml(changed, PisigmaError, source) != wanted:
        at = Place(source, None, ".".join(map(str, keys)))
        raise PisigmaError("this value cannot be changed alone", at=at, remedy="change it in the text")
    return changed


def _changed(content: Any, keys: Keys, value: Any, depth: int = 0) -> Any:
    """Return the plain values of a document after a change of one value."""
    key, *deeper = keys
    known = dict(enumerate(content)) if isinstance(content, list) else dict(content or {})
    if deeper:
        value = _changed(known.get(key), deeper, value, depth + 1)
        value = None if value in ({}, []) else value
    if value is not None or (deeper and depth == 0 and key in known):  # a section of the file may be empty
        known[key] = value
    else:
        known.pop(key, None)
    return list(known.values()) if isinstance(key, int) else known


def _edited(text: str, keys: Keys, value: Any, wanted: Any) -> str:
    """Return the changed text."""
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    parents: list[tuple[Any, Any]] = []
    start = 0
    for number, key in enumerate(keys):
        entry = _entry(node, key)
        if entry is None:
            for inner in reversed(keys[number + 1 :]):
                value = [value] if isinstance(inner, int) else {inner: value}
            return _with_added(text, start, parents[-1][0] if parents else node, node, key, value, wanted)
        parents.append((node, wanted))
        (start, node), wanted = entry, wanted[key] if _has(wanted, key) else None
    if value is not None:
        return _with_replaced(text, node, value)
    while len(parents) > 2 and len(parents[-1][0].value) == 1:
        parents.pop()
    (parent, left), key = parents[-1], keys[len(parents) - 1]
    start, node = _entry(parent, key) or (0, parent)
    first = text.rfind("\n", 0, start) + 1
    if parent.flow_style or text[first:start].strip() != ("-" if isinstance(key, int) else ""):
        return _with_replaced(text, parent, left)
    return text[:first] + text[text.index("\n", _end(node)) + 1 :]


def _has(content: Any, key: str | int) -> bool:
    return key in range(len(content)) if isinstance(content, list) else key in (content or {})


def _entry(node: yaml.Node, key: str | int) -> tuple[int, yaml.Node] | None:
    """Return the start of a collection's entry with a key, and its value; None if there is no such entry."""
    if isinstance(node, yaml.MappingNode):
        return next(((k.start_mark.index, v) for k, v in node.value if k.value == key), None)
    if isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(node.value):
        return node.value[key].start_mark.index, node.value[key]
    return None


def _end(node: yaml.Node) -> int:
    """Return the end of a value, excluding the comments after it, which YAML counts as part of block collections."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)


def _with_replaced(text: str, node: yaml.Node, value: Any) -> str:
    """Return the text with a value replaced by another, which is written in one line."""
    start, is_block = node.start_mark.index, isinstance(node, yaml.CollectionNode) and not node.flow_style
    is_apart = text[start - 1 : start].isspace() or text[start - 1 : start] in ("[", "{")
    # a block may begin in the column of its key, but a value in one line may not
    gap = "" if is_apart and not is_block else " "
    return f"{text[:start]}{gap}{yaml_text(value, in_one_line=True)}{text[_end(node) :]}"


def _with_added(
    text: str, start: int, parent: Any, node: Any, key: str | int, value: Any, wanted: Any
) -> str:
    """Return the text with a new entry in a collection: before the comment that states its default, or at the end.

    Args:
        text: the text.
        start: start of the collection's entry in its parent.
        parent: collection that contains the collection.
        node: the collection, or an empty value in its place.
        key: key of the new entry.
        value: value of the new entry.
        wanted: plain value of the collection with the entry.
    """
    is_empty = isinstance(node, yaml.ScalarNode)
    section = parent if is_empty else node
    if section.flow_style or isinstance(key, int) is not isinstance(section, yaml.SequenceNode):
        return _with_replaced(text, node, wanted)
    column = section.start_mark.column + (_INDENT if is_empty else 0)
    comments = _COMMENTS.match(text, node.start_mark.index)
    end = comments.end() if is_empty and comments else node.end_mark.index
    stated = re.compile(rf"^ {{{column}}}#[ ]?{re.escape(str(key))}:", re.MULTILINE).search(text, start, end)
    at = stated.start() if stated else text.index("\n", _end(node)) + 1
    name = "-" if isinstance(key, int) else f"{key}:"
    return f"{text[:at]}{' ' * column}{name} {yaml_text(value, in_one_line=True)}\n{text[at:]}"

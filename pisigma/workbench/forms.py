"""Forms for the settings of steps, and for the settings in `cell.yaml`."""

import hashlib
import itertools
import re
import shlex
import types
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pisigma.files.errors import PlanningError
from pisigma.files.setting import Setting, attribute_descriptions, flat_settings
from pisigma.files.yaml_file import Section, parse_plain_yaml
from pisigma.files.yaml_writing import with_changed_value
from pisigma.lifetime.cell.layout import CELL_FILE
from pisigma.robot.row import MAX_MAGNITUDE
from pisigma.workflow.cell.cell_file import CAMERA_KEYS, STATED_ABOVE, STEPS, CellDocument, CellFile

FIRST = {
    "plan": ("count", "check"),
    "calibrate": ("model", "folds"),
    "verify": (),
    "monitor": (),
    "recalibrate": (),
    "import": ("unit", "join"),
}
"""Settings that are shown at once; other settings are behind "all settings"."""
_NEW_CELL = {"sensor": "--sensor", "limit_mm": "--limit-mm"}
"""Settings of a new cell, with their options."""
_LEFT_OUT = ("map", "no_history")
"""Settings that have a form of their own, or that a cell does not have."""


@dataclass(frozen=True)
class Field:
    """A field of a form.

    Attributes:
        key: name of the field: the key of a setting in its section of `cell.yaml`, or in the whole file, with dots.
        help: effect of the setting, with unit.
        kind: "number", "flag", "choice", "list" or "text".
        choices: choices of a "choice".
        bounds: smallest and largest value that is accepted, such as ">= 0"; "" if there are none.
        default: value without an entry: the value in `cell.yaml`, otherwise the default; "" without a default.
        value: value that the form shows as entered.
        option: option of the command, or its start if a value follows without a space; "" without a command.
        shown_at_once: whether the field is shown at once, and not only behind "all settings".
    """

    key: str
    help: str
    kind: str
    choices: tuple[str, ...] = ()
    bounds: str = ""
    default: str = ""
    value: str = ""
    option: str = ""
    shown_at_once: bool = True

    @property
    def label(self) -> str:
        """Name of the field for people."""
        return self.key.rpartition(".")[2].replace("_", " ")

    @property
    def group(self) -> str:
        """Section of `cell.yaml` with the field."""
        return self.key.rpartition(".")[0]


def form_of(step: str, file: CellFile) -> list[Field]:
    """Return the fields of a step; files and cameras are omitted because a page must not name paths."""
    stated, fields = file.stated_values(step), []
    for one in _settings(step):
        key, option = one.key, one.name
        if one.option.is_key_only or one.default is False:  # no option switches these settings off
            option = f"--set {key}="
        default = _text(stated.get(key, one.default))
        fields.append(
            replace(_field(one), default=default, option=option, shown_at_once=key in FIRST.get(step, ()))
        )
    return fields


def form_of_cell(file: CellFile) -> dict[str, list[Field]]:
    """Return the fields of `cell.yaml` by section, with the values that the file states; "" is the cell itself."""
    text = file.path.read_text(encoding="utf-8")
    stated = parse_plain_yaml(text, PlanningError, str(file.path))
    fields: dict[str, list[Field]] = {"": []}
    for one in _section(CellDocument, stated, ""):
        fields.setdefault(one.key.rpartition(".")[0] and one.key.partition(".")[0], []).append(one)
    for step in STEPS:
        values = stated.get(step) or {}
        fields[step] = [
            replace(_field(one), key=f"{step}.{one.key}", value=_text(values.get(one.key)))
            for one in _settings(step)
            if one.key not in STATED_ABOVE.get(step, ())
        ]
    return fields


def form_of_new_cell() -> list[Field]:
    """Return the fields of a new cell besides its robot."""
    fields = {one.key: one for one in _section(CellDocument, {}, "")}
    return [replace(fields[key], option=option) for key, option in _NEW_CELL.items()]


def changed_cell_text(file: CellFile, form: Mapping[str, str]) -> str:
    """Return the text of `cell.yaml` with the values of a form; fields that the form lacks do not change.

    Raises:
        PisigmaError: the file is written in a way in which a value cannot be changed alone.
    """
    text = cell_file_text(file.path.parent)
    fields = itertools.chain.from_iterable(form_of_cell(file).values())
    entered = [(one, form.get(one.key, one.value).strip()) for one in fields]
    changed = [(one, value) for one, value in entered if value != one.value]
    removed = [(one, value) for one, value in changed if not value]
    stated = [(one, value) for one, value in changed if value]
    for one, value in [*stated, *reversed(removed)]:  # a removed item changes the numbers of later items
        keys = [int(part) if part.isdigit() else part for part in one.key.split(".")]
        text = with_changed_value(text, keys, _value(one.kind, value), str(file.path))
    return text


def cell_file_text(folder: Path) -> str:
    """Return the text of the `cell.yaml` in a folder, even where it is not UTF-8."""
    return (folder / CELL_FILE).read_text(encoding="utf-8", errors="replace")


def digest_of(text: str) -> str:
    """Return the SHA-256 of a text, which shows whether the text has changed since it was displayed."""
    return hashlib.sha256(text.encode()).hexdigest()


def _section(section: type[Section], stated: Any, prefix: str) -> Iterator[Field]:
    """Yield the fields of a section of `cell.yaml` and its sections; lists of sections get an empty section."""
    meanings = {
        key: text for one in reversed(section.__mro__) for key, text in attribute_descriptions(one).items()
    }
    for name, info in section.model_fields.items():
        key, kind, bounds = f"{prefix}{info.alias or name}", info.annotation, list(info.metadata)
        value = stated.get(name) if isinstance(stated, dict) else None
        while get_origin(kind) in (Annotated, Union, types.UnionType):
            bounds += get_args(kind)[1:] if get_origin(kind) is Annotated else ()
            kind = next(one for one in get_args(kind) if one is not type(None))
        item = get_args(kind)[0] if get_origin(kind) is tuple else None
        if isinstance(kind, type) and issubclass(kind, Section):
            yield from _section(kind, value, f"{key}.")
        elif isinstance(item, type) and issubclass(item, Section):
            for number, one in enumerate([*(value or ()), {}]):
                yield from _section(item, one, f"{key}.{number}.")
        elif get_origin(kind) is not dict:
            limits = " and ".join(filter(None, map(_bound, bounds)))
            default = "required" if info.is_required() else _text(info.default) or "not stated"
            meaning = re.split(r"[;.] None for ", meanings.get(name, ""))[0]  # an empty field states this
            help_ = f"{meaning[:1].upper()}{meaning[1:]}"
            yield Field(key, help_, *_kind(kind), limits, default, _text(value))


def _bound(constraint: Any) -> str:
    """Return a bound of a pydantic field as text; "" for other constraints."""
    for sign, name in ((">", "gt"), (">=", "ge"), ("<", "lt"), ("<=", "le")):
        if (bound := getattr(constraint, name, None)) is not None and abs(bound) < MAX_MAGNITUDE:
            return f"{sign} {bound:g}"
    return " and ".join(filter(None, map(_bound, getattr(constraint, "metadata", ()))))


def changed_settings(step: str, form: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of a form that a person entered, by the keys of settings."""
    keys = {one.key for one in _settings(step)}
    return {key: value.strip() for key, value in form.items() if key in keys and value.strip()}


def form_of_command(command: str) -> tuple[str, dict[str, str]]:
    """Return the step of a command that `status` recommends, and its words as the values of a form."""
    _, step, _, *words = shlex.split(command)
    if step == "session":
        return step, {"session": words[0], "set_aside": words[2]}
    keys = {one.name: one.key for one in _settings(step)} if step in FIRST else {}
    if step == "verify":
        keys |= {"--model": "of_model"}
    return step, {keys[name]: value for name, value in itertools.pairwise(words) if name in keys}


def _settings(step: str) -> list[Setting]:
    """Return the settings of a step that a page may change."""
    return [
        one
        for one in flat_settings(STEPS[step])
        if one.key not in (*CAMERA_KEYS, *_LEFT_OUT)
        and one.kind is not Path
        and get_origin(one.kind) is not list
    ]


def _field(setting: Setting) -> Field:
    """Return the field of a setting, with its default."""
    least, most = setting.option.min, setting.option.max
    bounds = [f"{sign} {bound:g}" for sign, bound in ((">=", least), ("<=", most)) if bound is not None]
    kind, choices = _kind(setting.kind)
    return Field(setting.key, setting.help, kind, choices, " and ".join(bounds), _text(setting.default))


def _kind(kind: Any) -> tuple[str, tuple[str, ...]]:
    """Return kind and choices of a field."""
    if get_origin(kind) is Literal:
        return "choice", tuple(map(str, get_args(kind)))
    if get_origin(kind) in (tuple, list):
        return "list", ()
    return {bool: "flag", int: "number", float: "number"}.get(kind, "text"), ()


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    return "" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)


def _value(kind: str, text: str) -> Any:
    """Return the entry of a person as a plain value; the setting refuses a text of another kind."""
    if kind == "list":
        return [_value("number", one.strip()) for one in text.split(",") if one.strip()] or None
    if kind == "flag":
        return {"true": True, "false": False}.get(text, text or None)
    if kind == "number":
        with suppress(ValueError):
            return float(text) if set(text) & set(".eE") else int(text)
    return text or None

"""Settings as dataclass fields, from which command-line options and documentation pages are generated.

The type and the default of a setting are those of the field, its help is the attribute's text in the docstring of the
class, and an `Option` in the annotation states how the command line differs.
"""

import functools
import inspect
import itertools
import math
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, ForwardRef, Literal, Union, get_args, get_origin

from pisigma.files.errors import PisigmaError, SettingError

_UNITS = {"mm": ("m", 1e-3), "mrad": ("rad", 1e-3), "deg": ("rad", math.pi / 180.0), "ms": ("s", 1e-3)}
"""SI unit and conversion factor by unit of the command line."""


@dataclass(frozen=True)
class Option:
    """Command-line form of a setting, as far as it does not follow from its name and type.

    Attributes:
        name: name of the option, such as "--camera"; None to make it from the name of the setting.
        kind: type of the command-line value if it differs from that of the setting.
        read: function that converts the command-line value to the setting.
        unit: unit of the command-line value, one of `_UNITS`; `read`, if given, must convert the value.
        min: smallest value that is accepted.
        max: largest value that is accepted.
        metavar: placeholder of the value in the help.
        default: default that the help shows, if the setting's default has another type.
        is_key_only: whether the setting has no option of its own and is set by its key, in `cell.yaml` and with
            `--set`.
        hidden: whether the setting can be set only in Python.
        help: help of the option if it differs from the description of the setting, as of `--no-history`.
    """

    name: str | None = None
    kind: Any = None
    read: Callable[[Any], Any] | None = None
    unit: str | None = None
    min: float | int | None = None
    max: float | int | None = None
    metavar: str | None = None
    default: Any = None
    is_key_only: bool = False
    hidden: bool = False
    help: str = ""


HIDDEN = Option(hidden=True)
"""Annotation of settings that can be set only in Python."""
KEY = Option(is_key_only=True)
"""Annotation of settings that have a key in `cell.yaml` but no option."""
FILE = Option(kind=Path, read=str)
"""Annotation of settings that are paths, stored as text."""


def as_texts(values: Iterable[object]) -> tuple[str, ...]:
    """Return several command-line values as strings."""
    return tuple(map(str, values))


def split_names(text: str) -> tuple[str, ...]:
    """Return the names in texts that separate names by commas."""
    return tuple(name.strip() for name in text.split(",")) if text else ()


NAMES = Option(kind=str, read=split_names)
"""Annotation of settings that consist of several names, separated by commas on the command line."""


@dataclass(frozen=True)
class Setting:
    """A setting of a class, as an option of the command line or a key of files and of `--set`.

    Attributes:
        field: name of the field in Python.
        kind: type of the command-line value, or the class of a group of settings.
        default: default in the unit of the option.
        is_required: whether there is no default.
        help: help text of the option.
        option: command-line form, see `Option`.
    """

    field: str
    kind: Any
    default: Any
    is_required: bool
    help: str
    option: Option

    @property
    def is_group(self) -> bool:
        """Whether the setting is itself a dataclass of settings."""
        return self.option.kind is None and is_dataclass(self.kind)

    @property
    def name(self) -> str:
        """Name of the option, such as "--limit-mm", even if the setting can only be set by its key."""
        return self.option.name or f"--{self.field.replace('_', '-')}"

    @property
    def key(self) -> str:
        """Key in files and of `--set`: the option without leading dashes, such as "prior_mm"."""
        return self.name.removeprefix("--").replace("-", "_")

    @property
    def spelling(self) -> str:
        """Spelling of the setting on the command line, such as "--folds" or "--set seed"."""
        return f"--set {self.key}" if self.option.is_key_only else self.name

    def read(self, value: Any) -> Any:
        """Convert a command-line value to the setting."""
        if self.option.read is not None:
            return self.option.read(value)
        return value if self.option.unit is None else value * _UNITS[self.option.unit][1]


@functools.cache
def settings_of(group: type) -> tuple[Setting, ...]:
    """Return the settings of a class that have command-line options or keys.

    A setting whose type cannot be resolved, because it is imported only for type checkers, is read as text.
    """
    meanings, found = attribute_descriptions(group), []
    for one in fields(group):
        module = vars(sys.modules[group.__module__])
        kind, option = _resolved(one.type, module), Option()
        if get_origin(kind) is Annotated:
            kind, option = _resolved(get_args(kind)[0], module), get_args(kind)[1]
        if option.hidden:
            continue
        is_required = one.default is MISSING and one.default_factory is MISSING
        default = _stated_default(None if one.default is MISSING else one.default, option)
        kind = option.kind or _stated_as(kind)
        meaning = _help(option.help or meanings.get(one.name, ""), option, get_origin(kind) is list)
        found.append(Setting(one.name, kind, default, is_required, meaning, option))
    return tuple(found)


@functools.cache
def flat_settings(group: type) -> tuple[Setting, ...]:
    """Return the settings of a class, including those of its fields that are classes of settings."""
    parts = [flat_settings(one.kind) if one.is_group else (one,) for one in settings_of(group)]
    return tuple(itertools.chain.from_iterable(parts))


def settings_by_key(group: type) -> dict[str, Setting]:
    """Return the settings of a class by their keys; see `flat_settings`."""
    return {one.key: one for one in flat_settings(group)}


def build_settings(group: type, values: Mapping[str, Any], is_optional: bool = False) -> Any:
    """Return an instance of a class of settings.

    Args:
        group: class of the settings.
        values: values by `Setting.key`, as on a command line; other settings keep their defaults.
        is_optional: whether to return None if no setting of the class is stated.

    Raises:
        PisigmaError: a required setting is missing, or a value is not valid, such as a number that is not finite;
            the option of the error is the key.
    """
    found: dict[str, Any] = {}
    for setting in settings_of(group):
        if setting.is_group:
            if (built := build_settings(setting.kind, values, is_optional=True)) is not None:
                found[setting.field] = built
        elif setting.key in values:
            value = values[setting.key]
            if isinstance(value, float) and not math.isfinite(value):
                raise SettingError(expected="a finite number", value=value, option=setting.key)
            found[setting.field] = setting.read(tuple(value) if isinstance(value, list) else value)
    if is_optional and not found:
        return None
    needed = [one for one in settings_of(group) if one.is_required]
    missing = [one for one in needed if one.field not in found]
    names = " and ".join(one.spelling for one in needed)
    if missing == needed != []:
        given = ", ".join(one.spelling for one in flat_settings(group) if one.key in values)
        raise PisigmaError(f"{names} must also be given", option=given, expected=names)
    if missing:
        raise PisigmaError(expected=f"{names} together", option=missing[0].spelling, remedy="give both")
    try:
        return group(**found)
    except PisigmaError as problem:  # the option of the error is the name of a field
        keys = {one.field: one.key for one in settings_of(group)}
        raise problem.with_option(" ".join(keys.get(word, word) for word in problem.option.split())) from None


def attribute_descriptions(described_class: type) -> dict[str, str]:
    """Return the text of every attribute in the docstring of a class."""
    # Python 3.13 and newer remove the indentation of docstrings, as `cleandoc` does
    lines = inspect.cleandoc(described_class.__doc__ or "").partition("Attributes:")[2].splitlines()
    found: dict[str, str] = {}
    last = ""
    for line in lines:
        if match := re.match(r"^ {4}(\w+): (.*)$", line):
            last = match[1]
            found[last] = match[2]
        elif last and line.startswith(" " * 8):
            found[last] += f" {line.strip()}"
    return found


def _resolved(kind: Any, names: dict[str, Any]) -> Any:
    if isinstance(kind, ForwardRef):
        kind = kind.__forward_arg__
    if not isinstance(kind, str):
        return kind
    try:
        return eval(kind, names)
    except NameError:
        return str


def _stated_as(kind: Any) -> Any:
    """Return the command-line type for the type of a setting: lists for tuples of any length, text for choices."""
    arguments = get_args(kind)
    if get_origin(kind) is Literal:
        return str
    if get_origin(kind) is tuple and arguments[-1] is Ellipsis:
        return list[arguments[0]]  # type: ignore[valid-type]
    if get_origin(kind) in (Union, types.UnionType):
        return next(_stated_as(one) for one in arguments if one is not type(None))
    return kind


def _stated_default(default: Any, option: Option) -> Any:
    if isinstance(default, bool) or option.kind is bool:
        return default is True and option.kind is None
    if option.unit is not None and default is not None:
        return float(f"{default / _UNITS[option.unit][1]:.6g}")
    if option.default is not None or (option.kind is not None and not isinstance(default, str)):
        return option.default
    return None if default == () else default


def _help(meaning: str, option: Option, is_repeated: bool) -> str:
    """Return the help text of an option, in complete sentences and in the unit of the option."""
    if option.unit is not None:
        meaning = meaning.replace(f"[{_UNITS[option.unit][0]}]", f"[{option.unit}]")
    meaning = re.sub(r"[;.]? None: ([^.]*)\.?$", r". [default: \1]", meaning)
    starts_with_choice = meaning.partition(" ")[0].endswith(":")
    sentence = meaning if starts_with_choice else meaning[:1].upper() + meaning[1:]
    return f"{sentence} May be repeated." if is_repeated else sentence

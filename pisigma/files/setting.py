"""Settings that are stated once: fields of a dataclass, of which command lines and pages of the documentation are made.

The type and the default of a setting are those of the field, what it means is what the docstring of the class says of
the attribute, and an `Option` in the annotation says what a command line has otherwise.
"""

import math
import re
import sys
import types
from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, ForwardRef, Literal, Union, get_args, get_origin

UNITS = {"mm": ("m", 1e-3), "mrad": ("rad", 1e-3), "deg": ("rad", math.pi / 180.0), "ms": ("s", 1e-3)}
"""Units of command lines, with those of settings and what one of them is there."""


@dataclass(frozen=True)
class Option:
    """How a setting is stated on a command line, where its name and type do not say.

    Attributes:
        name: of the option, such as "--class"; None for that of the setting.
        kind: type of what is stated, where it is not that of the setting.
        read: makes the setting of what is stated.
        unit: that is stated, one of `UNITS`; `read` turns it into that of the setting where there is one.
        least: that can be stated.
        most: that can be stated.
        metavar: what stands for the value in the help.
        default: what the help shows where the setting's own default is of another type.
        hidden: whether only Python states it.
    """

    name: str | None = None
    kind: Any = None
    read: Callable[[Any], Any] | None = None
    unit: str | None = None
    least: float | int | None = None
    most: float | int | None = None
    metavar: str | None = None
    default: Any = None
    hidden: bool = False


HIDDEN = Option(hidden=True)
"""Of settings that only Python states."""
FILE = Option(kind=Path, read=str)
"""Of settings that are a path as text."""


def texts(stated: Iterable[object]) -> tuple[str, ...]:
    """What is stated, as texts."""
    return tuple(map(str, stated))


def names(stated: str) -> tuple[str, ...]:
    """Names with commas between."""
    return tuple(name.strip() for name in stated.split(",")) if stated else ()


NAMES = Option(kind=str, read=names)
"""Of settings that are several names."""


@dataclass(frozen=True)
class Setting:
    """A setting of a class as a command line states it.

    Attributes:
        field: its name in Python.
        kind: type of what is stated, or the class of a group of settings.
        default: what holds where nothing is stated, in the option's unit.
        is_required: whether it has no default.
        help: what it means.
        option: see `Option`.
    """

    field: str
    kind: Any
    default: Any
    is_required: bool
    help: str
    option: Option

    @property
    def is_group(self) -> bool:
        """Whether it is made of settings of its own."""
        return self.option.kind is None and is_dataclass(self.kind)

    @property
    def name(self) -> str:
        """The option, such as "--prior-mm"."""
        return self.option.name or f"--{self.field.replace('_', '-')}"

    def read(self, stated: Any) -> Any:
        """The setting by what a command line states."""
        if self.option.read is not None:
            return self.option.read(stated)
        return stated if self.option.unit is None else stated * UNITS[self.option.unit][1]


def settings_of(group: type) -> list[Setting]:
    """The settings of a class that a command line states.

    A type that cannot be resolved, as it is imported for type checkers alone, is stated as text.
    """
    meanings, found = attributes_of(group), []
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
        meaning = _help(meanings.get(one.name, ""), option, get_origin(kind) is list)
        found.append(Setting(one.name, kind, default, is_required, meaning, option))
    return found


def attributes_of(documented: type) -> dict[str, str]:
    """What the docstring of a class says of every attribute."""
    lines = (documented.__doc__ or "").partition("Attributes:")[2].splitlines()
    found: dict[str, str] = {}
    last = ""
    for line in lines:
        if match := re.match(r"^ {8}(\w+): (.*)$", line):
            last = match[1]
            found[last] = match[2]
        elif last and line.startswith(" " * 12):
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
    """The type that a command line has for that of a setting: lists for tuples of any length, text for choices."""
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
        return float(f"{default / UNITS[option.unit][1]:.6g}")
    if option.default is not None or (option.kind is not None and not isinstance(default, str)):
        return option.default
    return None if default == () else default


def _help(meaning: str, option: Option, is_repeated: bool) -> str:
    """What an option means, in sentences and with its unit; what None means is its default."""
    if option.unit is not None:
        meaning = meaning.replace(f"[{UNITS[option.unit][0]}]", f"[{option.unit}]")
    meaning = re.sub(r"[;.]? None: ([^.]*)\.?$", r". [default: \1]", meaning)
    begins_with_choice = meaning.partition(" ")[0].endswith(":")
    sentence = meaning if begins_with_choice else meaning[:1].upper() + meaning[1:]
    return f"{sentence} May be repeated." if is_repeated else sentence

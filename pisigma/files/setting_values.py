"""Read values of settings by key from `cell.yaml`, a manifest or the option `--set`."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pisigma.files.errors import Place, SettingError, choice_remedy
from pisigma.files.setting import Setting

_TYPES = {bool: "true or false", int: "an integer", float: "a number", str: "a text", Path: "a path"}
"""Names of the types of settings for messages."""


def read_assignments(
    assignments: Iterable[str], settings: Mapping[str, Setting], option: str = ""
) -> dict[str, Any]:
    """Return the values of "KEY=VALUE" by their keys; a key that appears again adds to its list.

    Args:
        assignments: the texts.
        settings: settings by their keys.
        option: option that states the texts, for messages; empty for a file.

    Raises:
        SettingError: a text has a wrong form, a key is unknown, or a value has the wrong type or is out of range.
    """
    stated: dict[str, list[str]] = {}
    for one in assignments:
        key, sign, value = one.partition("=")
        if not sign:
            raise SettingError(expected="KEY=VALUE, such as seed=1", value=one, option=option)
        stated.setdefault(key.strip(), []).append(value)
    return dict(checked_values(stated, settings, lambda key: None))


def checked_values(
    values: Mapping[str, Any], settings: Mapping[str, Setting], place_of: Callable[[str], Place | None]
) -> Iterator[tuple[str, Any]]:
    """Yield keys and values, after converting every value to the type of its setting.

    Args:
        values: values by their keys, in the units of the command line.
        settings: settings by their keys.
        place_of: function that returns the place of a key in its file; None for values of the command line.

    Raises:
        SettingError: a key is unknown, or a value has the wrong type or is out of range.
    """
    from pydantic import TypeAdapter, ValidationError

    def setting_error(key: str, value: Any, expected: str, **texts: str) -> SettingError:
        at = place_of(key)
        return SettingError(expected=expected, value=value, at=at, option="" if at else key, **texts)

    for key, value in values.items():
        if key not in settings:
            problem, remedy = f"unknown key '{key}'", choice_remedy(key, settings)
            raise setting_error(key, key, f"one of {', '.join(settings)}", problem=problem, remedy=remedy)
        kind = settings[key].kind
        single = _listed(value, kind)
        several = single if isinstance(single, list | tuple) else (single,)
        # pydantic would read true as 1
        if kind is not bool and any(isinstance(one, bool) for one in several):
            raise setting_error(key, single, _type_text(kind))
        try:
            converted = TypeAdapter(kind).validate_python(single)
        except ValidationError:
            raise setting_error(key, single, _type_text(kind)) from None
        if missed := _missed_bounds(settings[key], converted):
            raise setting_error(key, single, missed)
        yield key, converted


def _listed(value: Any, kind: Any) -> Any:
    """Convert a value to a list if the setting may be repeated, or else a list of one value to that value."""
    is_list, is_repeated = isinstance(value, list | tuple), get_origin(kind) is list
    if is_list and not is_repeated and len(value) == 1:
        return value[0]
    return [value] if is_repeated and not is_list else value


def _type_text(kind: Any) -> str:
    """Return the name of a setting's type for messages."""
    if get_origin(kind) is Literal:
        return " or ".join(get_args(kind))
    return _TYPES.get(kind) or f"a list, each {_TYPES[get_args(kind)[0]]}"


def _missed_bounds(setting: Setting, value: Any) -> str:
    """Return a text with the valid range of a setting if a value is outside it; "" otherwise."""
    least, most = setting.option.min, setting.option.max
    if (least is None or value >= least) and (most is None or value <= most):
        return ""
    bounds = [f"{sign} {bound:g}" for sign, bound in ((">=", least), ("<=", most)) if bound is not None]
    return f"{_TYPES[setting.kind]} {' and '.join(bounds)}"

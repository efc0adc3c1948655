"""Options of commands, from the settings that the commands take."""

import functools
import inspect
import keyword
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any, get_args

import typer

from pisigma.files.errors import PisigmaError
from pisigma.files.setting import Setting, settings_of


def takes_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of its settings, in the place of every parameter whose type is such a class.

    The command gets what is built of them; where the parameter may be None, it is None where nothing is stated.
    """
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, bool]] = {}
    for one in inspect.signature(command).parameters.values():
        group, *others = get_args(one.annotation) or (one.annotation,)
        if not is_dataclass(group):
            parameters.append(one)
            continue
        groups[one.name] = group, bool(others)  # type: ignore[assignment]
        parameters += map(_parameter, _options(group))  # type: ignore[arg-type]

    @functools.wraps(command)
    def with_options(**values: Any) -> None:
        names = {_name(option) for group, _ in groups.values() for option in _options(group)}
        stated = {name: values.pop(name) for name in names}
        command(**values, **{name: _built(*group, stated) for name, group in groups.items()})

    by_name = inspect.Parameter.KEYWORD_ONLY
    vars(with_options)["__signature__"] = inspect.Signature([one.replace(kind=by_name) for one in parameters])
    with_options.__annotations__ = {one.name: one.annotation for one in parameters}
    return with_options


def _options(group: type) -> Iterator[Setting]:
    """All options of a class of settings, those of the groups in it too."""
    for setting in settings_of(group):
        if setting.is_group:
            yield from _options(setting.kind)
        else:
            yield setting


def _parameter(setting: Setting) -> inspect.Parameter:
    """The parameter of a command for an option."""
    option, name, default = setting.option, setting.name, setting.default
    kind = setting.kind
    if kind is bool and default:
        name = f"{name}/--no-{name[2:]}"
    bounds: dict[str, Any] = {"min": option.min, "max": option.max}
    shown = typer.Option(name, help=setting.help, metavar=option.metavar, **bounds)
    return inspect.Parameter(
        _name(setting),
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind if default is not None else kind | None, shown],
    )


def _name(setting: Setting) -> str:
    """Name of the parameter of a command for an option."""
    name = setting.name[2:].replace("-", "_")
    return f"{name}_" if keyword.iskeyword(name) else name


def _built(group: type, is_optional: bool, stated: Mapping[str, Any]) -> Any:
    """Settings by what is stated of them.

    Raises:
        BadParameter: only what says nothing by itself is stated.
        PisigmaError: a part is stated of what belongs together.
    """
    values, needed = {}, []
    for setting in settings_of(group):
        needed += [setting] if setting.is_required else []
        if setting.is_group:
            if (built := _built(setting.kind, True, stated)) is not None:
                values[setting.field] = built
        elif (value := stated[_name(setting)]) != setting.default and value not in (None, []):
            values[setting.field] = setting.read(tuple(value) if isinstance(value, list) else value)
    if is_optional and not values:
        return None
    names = " and ".join(one.name for one in needed)
    missing = [one for one in needed if one.field not in values]
    if needed and missing == needed:
        unused = ", ".join(one.name for one in _options(group) if stated[_name(one)] != one.default)
        raise typer.BadParameter(f"{unused}: only with {names}.")
    if missing:
        raise PisigmaError(f"{names} belong together; give both.")
    return group(**values)

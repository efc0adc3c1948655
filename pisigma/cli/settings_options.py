"""Options of commands, made from the settings that the commands take."""

import functools
import inspect
import keyword
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any, get_args

import typer

from pisigma.files.errors import PisigmaError
from pisigma.files.setting import Setting, settings_of

_CONTEXT = "context_of_command"
"""Parameter by which a command gets its context that does not ask for it."""


class StatedOptions(dict[str, Any]):
    """Options of settings that the command line states, by their keys in `cell.yaml`."""


def takes_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Replace every parameter of a command whose type is a class of settings by the options of that class.

    The command is called with the settings; a parameter that may be None is None if none of its options is given. A
    parameter of type `StatedOptions` gets the options that the command line states.
    """
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, bool]] = {}
    wants_stated = ""
    for one in inspect.signature(command).parameters.values():
        group, *others = get_args(one.annotation) or (one.annotation,)
        if group is StatedOptions:
            wants_stated = one.name
        elif not is_dataclass(group):
            parameters.append(one)
        else:
            groups[one.name] = group, bool(others)  # type: ignore[assignment]
            parameters += map(_parameter, _options(group))  # type: ignore[arg-type]
    context = next((one.name for one in parameters if one.annotation is typer.Context), None)
    if wants_stated and context is None:
        parameters.append(
            inspect.Parameter(_CONTEXT, inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        )

    @functools.wraps(command)
    def with_options(**values: Any) -> None:
        names = {_name(option) for group, _ in groups.values() for option in _options(group)}
        stated = {name: values.pop(name) for name in names}
        if wants_stated:
            running = values[context] if context else values.pop(_CONTEXT)
            values[wants_stated] = StatedOptions(
                (option.name[2:].replace("-", "_"), stated[_name(option)])
                for group, _ in groups.values()
                for option in _options(group)
                if running.get_parameter_source(_name(option)).name == "COMMANDLINE"
            )
        command(**values, **{name: _built(*group, stated) for name, group in groups.items()})

    by_name = inspect.Parameter.KEYWORD_ONLY
    vars(with_options)["__signature__"] = inspect.Signature([one.replace(kind=by_name) for one in parameters])
    with_options.__annotations__ = {one.name: one.annotation for one in parameters}
    return with_options


def _options(group: type) -> Iterator[Setting]:
    """Yield all options of a class of settings, including those of the groups in it."""
    for setting in settings_of(group):
        if setting.is_group:
            yield from _options(setting.kind)
        else:
            yield setting


def _parameter(setting: Setting) -> inspect.Parameter:
    """Return the parameter of a command for an option."""
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
    """Return the name of the parameter of a command for an option."""
    name = setting.name[2:].replace("-", "_")
    return f"{name}_" if keyword.iskeyword(name) else name


def _built(group: type, is_optional: bool, stated: Mapping[str, Any]) -> Any:
    """Build settings from the values of their options.

    Raises:
        BadParameter: only options that need others are given.
        PisigmaError: only some of the options that are needed together are given.
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
        raise typer.BadParameter(f"needs {names}", param_hint=unused)
    if missing:
        raise PisigmaError(expected=f"{names} together", option=missing[0].name, remedy="give both")
    return group(**values)

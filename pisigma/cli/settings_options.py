"""Options of commands, made from the settings that the commands take."""

import functools
import inspect
import keyword
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Annotated, Any, get_args

import typer

from pisigma.files.setting import Setting, build_settings, flat_settings

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
            parameters += map(_parameter, flat_settings(group))  # type: ignore[arg-type]
    context = next((one.name for one in parameters if one.annotation is typer.Context), None)
    if wants_stated and context is None:
        parameters.append(
            inspect.Parameter(_CONTEXT, inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        )

    @functools.wraps(command)
    def with_options(**values: Any) -> None:
        options = {option.key: option for group, _ in groups.values() for option in flat_settings(group)}
        stated = {key: values.pop(_name(option)) for key, option in options.items()}
        if wants_stated:
            running = values[context] if context else values.pop(_CONTEXT)
            values[wants_stated] = StatedOptions(
                (key, stated[key])
                for key, option in options.items()
                if running.get_parameter_source(_name(option)).name == "COMMANDLINE"
            )
        chosen = {
            key: value
            for key, value in stated.items()
            if value not in (None, []) and value != options[key].default
        }
        built = {name: build_settings(group, chosen, none) for name, (group, none) in groups.items()}
        command(**values, **built)

    by_name = inspect.Parameter.KEYWORD_ONLY
    vars(with_options)["__signature__"] = inspect.Signature([one.replace(kind=by_name) for one in parameters])
    with_options.__annotations__ = {one.name: one.annotation for one in parameters}
    return with_options


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
    return f"{setting.key}_" if keyword.iskeyword(setting.key) else setting.key

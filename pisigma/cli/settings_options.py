"""Make the options of commands from their settings."""

import functools
import inspect
import keyword
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, Generic, TypeVar, get_args, get_origin

import typer

from pisigma.files.errors import SettingError
from pisigma.files.setting import Setting, build_settings, flat_settings, settings_by_key
from pisigma.files.setting_values import read_assignments

SETTINGS = "settings_by_key"
"""Name of the attribute of a command with its settings by key."""
_CONTEXT, _SET = "context_of_command", "assignments"
"""Names of the parameters by which a command gets its context and the values of `--set`."""

Group = TypeVar("Group")


@dataclass(frozen=True)
class StatedSettings(Generic[Group]):
    """Settings stated on a command line, for commands that may read other settings from a cell.

    Attributes:
        group: class of the settings.
        values: stated values by their keys.
    """

    group: type[Group]
    values: Mapping[str, Any]

    def build(self) -> Group:
        """Return the settings without a cell; settings that are not stated have their defaults.

        Raises:
            PisigmaError: a value is not valid.
        """
        built = build_settings(self.group, self.values)
        assert isinstance(built, self.group)
        return built


def takes_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the options of all classes of settings among its parameters.

    The command is called with the settings; a parameter that may be None is None if none of its settings is stated.
    A parameter of type `StatedSettings[...]` gets the stated settings. If a setting has no option of its own, the
    command also gets the option `--set`, which states any setting by its key.
    """
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, bool]] = {}
    as_stated, end = set(), 0
    for one in inspect.signature(command).parameters.values():
        group, *others = get_args(one.annotation) or (one.annotation,)
        if not is_dataclass(group):
            parameters.append(one)
            continue
        groups[one.name] = group, bool(others)  # type: ignore[assignment]
        if get_origin(one.annotation) is StatedSettings:
            as_stated.add(one.name)
        parameters += [_parameter(one) for one in flat_settings(group) if not one.option.is_key_only]  # type: ignore[arg-type]
        end = len(parameters)
    known = {key: one for group, _ in groups.values() for key, one in settings_by_key(group).items()}
    context = next((one.name for one in parameters if one.annotation is typer.Context), _CONTEXT)
    by_name = inspect.Parameter.KEYWORD_ONLY
    if any(one.option.is_key_only for one in known.values()):
        parameters.insert(end, _assignments(known))
    if context == _CONTEXT:
        parameters.append(inspect.Parameter(_CONTEXT, by_name, annotation=typer.Context))

    @functools.wraps(command)
    def with_options(**values: Any) -> None:
        running = values.pop(_CONTEXT) if context == _CONTEXT else values[context]
        stated = _stated(values, known, running)
        for name, (group, is_optional) in groups.items():
            own = {key: stated[key] for key in settings_by_key(group) if key in stated}
            values[name] = (
                StatedSettings(group, own) if name in as_stated else build_settings(group, own, is_optional)
            )
        command(**values)

    vars(with_options)["__signature__"] = inspect.Signature([one.replace(kind=by_name) for one in parameters])
    vars(with_options)[SETTINGS] = known
    with_options.__annotations__ = {one.name: one.annotation for one in parameters}
    return with_options


def _assignments(known: Mapping[str, Setting]) -> inspect.Parameter:
    """Return the parameter of the option `--set`, with the completion of its keys."""
    option = typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="State a setting by its key, as in cell.yaml; --help-all lists the keys. May be repeated.",
        autocompletion=lambda incomplete: [f"{key}=" for key in known if key.startswith(incomplete)],
    )
    kind = Annotated[list[str] | None, option]
    return inspect.Parameter(_SET, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)


def _stated(values: dict[str, Any], known: Mapping[str, Setting], running: Any) -> dict[str, Any]:
    """Remove the options of settings from the values of a command, and return the stated settings by key."""
    stated = read_assignments(values.pop(_SET, None) or (), known, "--set")
    for key, setting in known.items():
        if setting.option.is_key_only:
            continue
        value = values.pop(_name(setting))
        if running.get_parameter_source(_name(setting)).name != "COMMANDLINE":
            continue
        if key in stated:
            problem = f"the setting is stated twice, by {setting.name} and by --set"
            raise SettingError(
                problem, expected="one value", value=stated[key], option=key, remedy="omit one of them"
            )
        stated[key] = value
    return stated


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

"""Forms made from the settings of steps."""

import itertools
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pisigma.files.setting import Setting, flat_settings
from pisigma.workflow.cell.cell_file import CAMERA_KEYS, STEPS, CellFile

FIRST = {
    "plan": ("count", "check"),
    "calibrate": ("model", "folds"),
    "verify": (),
    "monitor": (),
    "recalibrate": (),
}
"""Settings that are shown at once; the others are behind "all settings"."""
LEFT_OUT = ("map", "no_history")
"""Settings of a form of their own, or that a cell does not have."""


@dataclass(frozen=True)
class Field:
    """A field of a form.

    Attributes:
        key: key of the setting in `cell.yaml`.
        option: option of the command, or its start if a value follows without a space.
        help: what it does, with unit and bounds.
        kind: "number", "flag", "choice" or "text".
        choices: choices of a "choice".
        default: value without an entry: that of `cell.yaml`, else the default; "" if there is none.
        first: whether it is shown at once.
    """

    key: str
    option: str
    help: str
    kind: str
    choices: tuple[str, ...]
    default: str
    first: bool


def form_of(step: str, file: CellFile) -> list[Field]:
    """Return the fields of a step; files and cameras are not among them, as a page must not name paths."""
    stated = file.stated_values(step)
    return [
        Field(
            one.key,
            f"--set {one.key}="
            if one.option.is_key or one.default is False
            else one.name,  # no option switches off
            one.help,
            _kind(one),
            tuple(map(str, get_args(one.kind))) if get_origin(one.kind) is Literal else (),
            _text(stated.get(one.key, one.default)),
            one.key in FIRST[step],
        )
        for one in _settings(step)
    ]


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
        if one.key not in (*CAMERA_KEYS, *LEFT_OUT)
        and one.kind is not Path
        and get_origin(one.kind) is not list
    ]


def _kind(setting: Setting) -> str:
    if setting.kind is bool:
        return "flag"
    if setting.kind in (int, float):
        return "number"
    return "choice" if get_origin(setting.kind) is Literal else "text"


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)

"""Generate the tables of all settings shared by command line and Python from their classes.

`python docs/hooks/setting_tables.py` updates the page.
"""

import inspect
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args

from recipe_tables import page_with
from typer.main import get_command

from pisigma.cli.main import app
from pisigma.files.setting import Setting, settings_of

PAGE = Path(__file__).parent.parent / "reference" / "settings.md"


def tables() -> str:
    """Return a table for every class of settings, first those of commands, then their groups."""
    commands: dict[type, list[str]] = {}
    for name, group in _groups(get_command(app)):
        commands.setdefault(group, []).append(name)
    every = list(commands)
    for group in every:
        every += [one.kind for one in settings_of(group) if one.is_group and one.kind not in every]
    return "\n".join(_table(group, commands.get(group, [])) for group in every)


def _groups(command: Any, path: tuple[str, ...] = ("pisigma",)) -> Iterator[tuple[str, type]]:
    """Yield every command with every class of settings that it takes."""
    for name, one in getattr(command, "commands", {}).items():
        yield from _groups(one, (*path, name))
    if not hasattr(command, "commands"):
        for parameter in inspect.signature(inspect.unwrap(command.callback)).parameters.values():
            kind = next(iter(get_args(parameter.annotation)), parameter.annotation)
            if is_dataclass(kind):
                yield " ".join(path), kind


def _table(group: type, commands: list[str]) -> str:
    summary = (group.__doc__ or "").strip().splitlines()[0]
    used = f" Used by {', '.join(f'`{name}`' for name in commands)}." if commands else ""
    lines = [f"### {group.__name__}", "", f"{summary}{used}", ""]
    lines += ["| option | in Python | default | meaning |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(_cells(one))} |" for one in settings_of(group)]
    return "\n".join([*lines, ""])


def _cells(setting: Setting) -> tuple[str, ...]:
    if setting.is_group:
        name = setting.kind.__name__
        return f"see [{name}](#{name.lower()})", f"`{setting.field}`", "", setting.help
    meaning, _, default = setting.help.partition(" [default: ")
    if setting.kind is bool:
        default = "on" if setting.default else "off"
    elif setting.default not in (None, ""):
        default = f"`{setting.default}`"
    return (
        f"`{setting.spelling}`",
        f"`{setting.field}`",
        default.removesuffix("]"),
        meaning.replace("*", "\\*"),
    )


if __name__ == "__main__":
    PAGE.write_text(page_with(PAGE.read_text(encoding="utf-8"), tables()), encoding="utf-8")

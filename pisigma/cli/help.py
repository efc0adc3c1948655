"""Help of commands: `--help` shows their options briefly, `--help-all` also every key of `--set`."""

import copy
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, get_args

import typer
from typer.core import TyperCommand

from pisigma.cli.settings_options import SETTINGS
from pisigma.files.setting import Setting

RARELY_USED = {
    "export": (
        "--tip", "--geometry", "--config", "--frames", "--tolerance-mm", "--counts-per-turn", "--present-counts",
        "--payload-kg", "--temperature-c",
    ),
}  # fmt: skip
"""Options, of commands without settings, that only `--help-all` shows."""
_SHOWS_ALL = "pisigma.help_all"


class ShortHelpCommand(TyperCommand):
    """A command whose `--help` shows options briefly, and whose `--help-all` also shows the keys of `--set`."""

    @property
    def keys(self) -> dict[str, Setting]:
        """Return the settings without an option, by key."""
        known: dict[str, Setting] = getattr(self.callback, SETTINGS, {})
        return {key: one for key, one in known.items() if one.option.is_key_only}

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options briefly, with their number, or in full with the keys of `--set`."""
        if ctx.meta.get(_SHOWS_ALL):
            super().format_options(ctx, formatter)
            if self.keys:
                with formatter.section("Keys of --set, in addition to the options without their dashes"):
                    formatter.write_dl([(_assignment(one), _explained(one)) for one in self.keys.values()])
            return
        hidden = set(RARELY_USED.get(str(self.name), ()))
        short = copy.copy(self)
        short.params = [_in_a_sentence(one) for one in self.params if hidden.isdisjoint(one.opts)]
        TyperCommand.format_options(short, ctx, formatter)
        count = sum(one.param_type_name == "option" for one in self.get_params(ctx))
        keys = " and the keys of --set" if self.keys else ""
        formatter.write_paragraph()
        formatter.write_text(f"--help-all shows all {count} options{keys}.")

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        """Parse the arguments; with `--json`, also print errors in them as JSON."""
        with _usage_errors_as_json("--json" in args):
            try:
                return super().make_context(info_name, args, parent, **extra)
            except Exception as problem:
                self._name_key(problem)
                raise

    def _name_key(self, problem: Any) -> None:
        """Add the key to the error of an unknown option, if a setting without an option has this name."""
        key = str(getattr(problem, "option_name", "")).removeprefix("--").replace("-", "_")
        value = "VALUE"
        if key not in self.keys and key.startswith("no_"):
            key, value = key.removeprefix("no_"), "false"
        if hasattr(problem, "possibilities") and key in self.keys:
            problem.possibilities = []
            problem.message = f"No such option: {problem.option_name}. Use --set {key}={value}."

    def invoke(self, ctx: Any) -> Any:
        """Run the command; with `--json`, also print errors in its options as JSON."""
        with _usage_errors_as_json(bool(ctx.params.get("as_json"))):
            return super().invoke(ctx)


@contextmanager
def _usage_errors_as_json(as_json: bool) -> Iterator[None]:
    """Print the fields of an error of the command line on stdout before it is reported on stderr."""
    try:
        yield
    except Exception as problem:
        if as_json and hasattr(problem, "format_message"):
            fields = {"class": type(problem).__name__, "message": problem.format_message()}
            parameter = getattr(problem, "param", None)
            names = getattr(problem, "option_name", None) or (parameter.opts[0] if parameter else "")
            typer.echo(json.dumps({"error": fields | ({"option": names} if names else {})}))
        raise


def _in_a_sentence(parameter: Any) -> Any:
    """Return the parameter with the first sentence of its help, and with its default."""
    if parameter.param_type_name != "option":
        return parameter
    short = copy.copy(parameter)
    short.help = re.sub(r"\. (?!\[default).*?(?= \[default|$)", ".", parameter.help or "")
    return short


def _assignment(setting: Setting) -> str:
    """Return the form of an assignment of a key, such as "seed=INT"."""
    kinds = get_args(setting.kind) or (setting.kind,)
    names = [one if isinstance(one, str) else one.__name__.upper() for one in kinds]
    return f"{setting.key}={setting.option.metavar or '|'.join(names)}"


def _explained(setting: Setting) -> str:
    """Return the meaning of a key, with its default."""
    default = setting.default
    if default in (None, "") or "[default: " in setting.help:
        return setting.help
    return f"{setting.help} [default: {str(default).lower() if isinstance(default, bool) else default}]"


def _show_all(ctx: Any, value: bool) -> bool:
    if value and not ctx.resilient_parsing:
        ctx.meta[_SHOWS_ALL] = True
        typer.echo(ctx.get_help())
        raise typer.Exit
    return value


HelpAll = Annotated[
    bool, typer.Option("--help-all", is_eager=True, callback=_show_all, help="Show all options and exit.")
]
"""Option `--help-all` of every command, which shows the full help."""

"""Help of commands: `--help` shows the options that are used most, `--help-all` shows every option.

An option that is hidden from `--help` still works, and shells still complete it.
"""

import copy
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

_OF_ALL_COMMANDS = ("--plugin",)
_IMAGES = ("--fixed-camera", "--repeatability-mm", "--repeatability-deg", "--intrinsics")

RARELY_USED: Mapping[str, tuple[str, ...]] = {
    "plan": (
        *_IMAGES[:3], "--sigma-px", "--sigma-mm", "--candidates", "--candidates-from", "--seed", "--speed-deg-s",
        "--settling-s", "--criterion", "--base", "--tip",
    ),
    "calibrate": (
        *_IMAGES, "--hold-out", "--repeats", "--seed", "--train-rows", "--free", "--robust", "--gravity", "--class",
        "--features", "--base", "--tip", "--jobs",
    ),
    "recalibrate": _IMAGES,
    "monitor": _IMAGES,
    "compare": (*_IMAGES, "--level"),
    "evaluate": (*_IMAGES, "--resamples", "--seed", "--sha256"),
    "verify": _IMAGES,
    "report": _IMAGES,
    "import": ("--decimal", "--within"),
    "measure": ("--view-host", "--view-port", "--view-urdf"),
    "ik": ("--elbow-deg", "--tolerance-deg", "--payload-kg", "--temperature-c"),
    "export": (
        "--tip", "--geometry", "--config", "--frames", "--tolerance-mm", "--counts-per-turn", "--present-counts",
        "--payload-kg", "--temperature-c",
    ),
}  # fmt: skip
"""Options that only `--help-all` shows, by command, in addition to the common ones."""

_SHOWS_ALL = "pisigma.help_all"


class ShortHelpCommand(TyperCommand):
    """A command whose `--help` shows the options that are used most."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options that are used most, or all of them, and say how many there are."""
        if ctx.meta.get(_SHOWS_ALL):
            super().format_options(ctx, formatter)
            return
        hidden = {*_OF_ALL_COMMANDS, *RARELY_USED.get(str(self.name), ())}
        short = copy.copy(self)
        short.params = [_in_a_sentence(one) for one in self.params if hidden.isdisjoint(one.opts)]
        TyperCommand.format_options(short, ctx, formatter)
        count = sum(one.param_type_name == "option" for one in self.get_params(ctx))
        formatter.write_paragraph()
        formatter.write_text(f"--help-all shows all {count} options.")

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        """Parse the arguments; with `--json`, print what is wrong with them as JSON too."""
        with _usage_errors_as_json("--json" in args):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; with `--json`, print what is wrong with its options as JSON too."""
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


def _show_all(ctx: Any, value: bool) -> bool:
    if value and not ctx.resilient_parsing:
        ctx.meta[_SHOWS_ALL] = True
        typer.echo(ctx.get_help())
        raise typer.Exit
    return value


HelpAll = Annotated[
    bool, typer.Option("--help-all", is_eager=True, callback=_show_all, help="Show all options and exit.")
]
"""The option of every command that shows its whole help."""

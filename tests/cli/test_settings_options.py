"""Options of commands are those of the settings that they take, with the defaults that Python has."""

import dataclasses
import importlib
import pkgutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from testing.refusals import refused
from typer.testing import CliRunner

from pisigma.cli.main import app
from pisigma.cli.settings_options import takes_settings
from pisigma.deployment.serve import settings as serve_settings
from pisigma.files.errors import PisigmaError, SettingError
from pisigma.files.setting import FILE, KEY, Option, flat_settings, settings_by_key, settings_of
from pisigma.files.setting_values import checked_values, read_assignments
from pisigma.planning import plan_settings
from pisigma.workflow import settings as of_commands


@dataclass(frozen=True)
class Lens:
    """Lens.

    Attributes:
        file: where it is.
        sheet: what it sees.
        width: how wide it is [m].
        depth: how deep it is [m].
    """

    file: Annotated[str, FILE]
    sheet: Annotated[str, FILE]
    width: Annotated[float, Option("--width-mm", unit="mm")] = 1e-3
    depth: Annotated[float, Option("--depth-mm", unit="mm", min=0, is_key_only=True)] = 2e-3


@dataclass(frozen=True)
class Settings:
    """Settings.

    Attributes:
        count: how many.
        is_class: of a name that Python keeps for itself.
        bright: on where nothing is stated.
        marks: several numbers.
        lens: that sees.
        lines: several more.
        quick: whether to hurry.
    """

    count: Annotated[int, Option(min=1)] = 5
    is_class: Annotated[str | None, Option("--class")] = None
    bright: bool = True
    marks: tuple[int, ...] = ()
    lens: Lens | None = None
    lines: Annotated[tuple[int, ...], KEY] = ()
    quick: Annotated[bool, KEY] = False


@pytest.fixture
def built():
    """Give what a command line is built into."""
    seen: list[Settings] = []

    @takes_settings
    def command(data: Path, settings: Settings, plain: bool = False) -> None:
        seen.append(settings)

    small = typer.Typer()
    small.command()(command)

    def run(*words: str) -> Settings:
        result = CliRunner().invoke(small, ["rows.csv", *words])
        if isinstance(result.exception, PisigmaError):
            raise result.exception
        assert result.exit_code == 0, result.output
        return seen[-1]

    return run


def test_what_is_not_stated_is_as_python_has_it(built):
    assert built() == built("--plain") == Settings()


def test_options_are_settings(built):
    words = ("--count", "2", "--class", "x", "--no-bright", "--marks", "1", "--marks", "2")
    assert built(*words) == Settings(2, "x", False, (1, 2))
    lens = built("--file", "a.yaml", "--sheet", "b.yaml", "--width-mm", "2").lens
    assert lens == Lens("a.yaml", "b.yaml", 2e-3)


def test_what_needs_something_else_is_refused(built):
    with refused(PisigmaError, option="--sheet", expected="--file and --sheet together"):
        built("--file", "a.yaml")
    with refused(PisigmaError, option="--width-mm", expected="--file and --sheet"):
        built("--width-mm", "2")
    with refused(PisigmaError, option="--set depth_mm", expected="--file and --sheet"):
        built("--set", "depth_mm=2")
    with pytest.raises(AssertionError, match="--count"):
        built("--count", "0")


def test_keys_are_settings(built):
    def with_keys(*assignments: str) -> Settings:
        return built(*(word for one in assignments for word in ("--set", one)))

    assert with_keys("count=2", "class=x", "bright=false", "marks=1", "marks=2") == Settings(
        2, "x", False, (1, 2)
    )
    assert with_keys("lines=3") == Settings(lines=(3,))
    assert with_keys("lines=3", "lines=4", "quick=true") == Settings(lines=(3, 4), quick=True)
    lens = built("--file", "a.yaml", "--set", "sheet=b=c.yaml", "--set", "depth_mm=0").lens
    assert lens == Lens("a.yaml", "b=c.yaml", depth=0.0)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("words", [("--width-mm",), ("--set", "width_mm="), ("--set", "depth_mm=")])
def test_numbers_are_finite(built, words, value):
    *option, last = words
    stated = (*option, f"{last}{value}") if option else (last, value)
    key = (option and last[:-1]) or "width_mm"
    with refused(SettingError, option=key):
        built("--file", "a.yaml", "--sheet", "b.yaml", *stated)


@pytest.mark.parametrize("value", [True, False, [True]])
@pytest.mark.parametrize("key", ["count", "width_mm", "lines", "class", "file"])
def test_truth_in_a_file_is_not_a_number_or_a_text(key, value):
    known = settings_by_key(Settings)
    with refused(SettingError, option=key):
        dict(checked_values({key: value}, known, lambda key: None))


@pytest.mark.parametrize("key", [one.key for one in flat_settings(Settings)])
def test_no_setting_gets_an_empty_value_by_accident(key):
    """An empty text is a text; everything else is refused, and so are several values of a single one."""
    known = settings_by_key(Settings)
    for stated in ([f"{key}="], [f"{key}=2", f"{key}=3"]):
        is_stated = "text" if len(stated) == 1 else "list"
        takes = {"class": "text", "file": "text", "sheet": "text", "marks": "list", "lines": "list"}.get(key)
        if takes != is_stated:
            with refused(SettingError, option=key):
                read_assignments(stated, known, "--set")


def test_shells_complete_keys():
    shell = {
        "_PISIGMA_COMPLETE": "complete_bash",
        "COMP_WORDS": "pisigma calibrate --set socket_d",
        "COMP_CWORD": "3",
    }
    assert CliRunner().invoke(app, [], prog_name="pisigma", env=shell).output.split() == ["socket_distance="]


@pytest.mark.parametrize(
    ("words", "fields"),
    [
        (("--set", "line=3"), {"option": "line", "value": "line"}),
        (("--set", "lines"), {"option": "--set", "value": "lines", "expected": "KEY=VALUE, such as seed=1"}),
        (("--set", "lines=x"), {"option": "lines", "value": ["x"], "expected": "a list, each an integer"}),
        (("--set", "quick=maybe"), {"option": "quick", "value": "maybe", "expected": "true or false"}),
        (("--set", "count=2.5"), {"option": "count", "value": "2.5", "expected": "an integer"}),
        (("--set", "count="), {"option": "count", "value": "", "expected": "an integer"}),
        (("--set", "count=0"), {"option": "count", "value": "0", "expected": "an integer >= 1"}),
        (("--set", "depth_mm=nan"), {"option": "depth_mm", "value": "nan", "expected": "a number >= 0"}),
        (("--set", "count=2", "--set", "count=3"), {"option": "count", "value": ["2", "3"]}),
        (("--count", "2", "--set", "count=2"), {"option": "count", "value": 2}),
    ],
)
def test_a_key_at_fault_is_refused(built, words, fields):
    with refused(SettingError, **fields):
        built(*words)


def settings_classes() -> list[type]:
    """Classes of settings of all commands, and those of which they are made."""
    names = [f"{of_commands.__name__}.{one.name}" for one in pkgutil.iter_modules(of_commands.__path__)]
    modules = map(importlib.import_module, [*names, plan_settings.__name__, serve_settings.__name__])
    found = {
        value for module in modules for value in vars(module).values() if dataclasses.is_dataclass(value)
    }
    return sorted((one for one in found if isinstance(one, type)), key=lambda one: one.__name__)


@pytest.mark.parametrize("group", settings_classes(), ids=lambda one: one.__name__)
def test_defaults_of_every_command_are_those_of_python(group):
    """In the units of Python, also where the command line has another one."""
    own = {one.name: one for one in dataclasses.fields(group)}
    for setting in settings_of(group):
        if setting.is_required or setting.is_group or setting.default is None:
            continue
        python, read = own[setting.field].default, setting.read(setting.default)
        assert read == (pytest.approx(python, rel=1e-12) if isinstance(python, float) else python), (
            setting.name
        )

import inspect
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Literal

from testing.closeness import assert_close

from pisigma.files.setting import FILE, HIDDEN, NAMES, Option, attribute_descriptions, settings_of

if TYPE_CHECKING:
    from elsewhere import Kind  # type: ignore[import-not-found]


@dataclass(frozen=True)
class Inner:
    """Inner.

    Attributes:
        length: how far it reaches [m].
    """

    length: Annotated[float, Option("--reach-mm", unit="mm", min=0, max=5.0)] = 2e-3


@dataclass(frozen=True)
class Outer:
    """Outer.

    Attributes:
        count: how many there are, which may be described on
            two lines. None: as many as fit.
        kind: fast: at once; slow: later.
        elsewhere: of a type that is not there.
        words: what is named.
        lines: which are meant.
        table: that is read.
        quiet: say nothing.
        loud: say all.
        inner: see `Inner`.
        secret: of Python.
    """

    count: int | None = None
    kind: Literal["fast", "slow"] = "fast"
    elsewhere: "Kind | None" = None
    words: Annotated[tuple[str, ...] | None, NAMES] = None
    lines: tuple[int, ...] = ()
    table: Annotated[str | None, FILE] = None
    quiet: bool = False
    loud: bool = True
    inner: Inner = field(default_factory=Inner)
    secret: Annotated[int, HIDDEN] = 3


SETTINGS = {one.field: one for one in settings_of(Outer)}


def test_hidden_fields_are_not_options():
    assert list(SETTINGS) == [name for name in Outer.__dataclass_fields__ if name != "secret"]
    kinds = {name: one.kind for name, one in SETTINGS.items()}
    assert (kinds["count"], kinds["kind"], kinds["elsewhere"], kinds["words"]) == (int, str, str, str)
    assert kinds["lines"] == list[int]
    defaults = {name: one.default for name, one in SETTINGS.items()}
    assert (defaults["kind"], defaults["quiet"], defaults["loud"], defaults["lines"]) == (
        "fast",
        False,
        True,
        None,
    )
    assert SETTINGS["inner"].is_group


def test_help_is_taken_from_the_docstring():
    assert attribute_descriptions(Outer)["count"].endswith("described on two lines. None: as many as fit.")
    assert SETTINGS["count"].help.startswith("How many there are")
    assert SETTINGS["count"].help.endswith("on two lines. [default: as many as fit]")
    assert SETTINGS["kind"].help == "fast: at once; slow: later."
    assert SETTINGS["lines"].help == "Which are meant. May be repeated."


def test_option_units_are_converted_to_setting_units():
    (reach,) = settings_of(Inner)
    assert (reach.name, reach.default, reach.help) == ("--reach-mm", 2.0, "How far it reaches [mm].")
    assert_close(reach.read(3.0), 3e-3, rtol=1e-15)
    assert SETTINGS["words"].read("a, b") == ("a", "b")
    assert SETTINGS["words"].read("") == ()


def test_docstrings_without_indentation_are_read():
    """Python 3.13 removes the indentation of docstrings."""
    stripped = type("Outer", (), {"__doc__": inspect.cleandoc(Outer.__doc__)})
    assert attribute_descriptions(stripped) == attribute_descriptions(Outer)
    assert attribute_descriptions(stripped)["count"].endswith("described on two lines. None: as many as fit.")

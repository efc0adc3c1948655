"""What people read of a result: the verdict first and last, warnings, and as many tables as a screen has room for."""

import pytest

from pisigma.cli import progress
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import MAX_LINES, print_result, print_screen
from pisigma.files.progress import completed_fraction, step_name
from pisigma.reporting.result_text import (
    MAX_ALIKE,
    Block,
    ResultText,
    merge_alike_warnings,
    numbers_as_ranges,
)
from pisigma.reporting.verdict import Verdict, rounded_text, uncapitalised

VERDICT = Verdict("0.12 mm RMS, held out; nominal 1 mm.", "yes, for all: nothing is wrong.", "verify it.")


def printed(capsys, *blocks, verbose=False, warnings=()):
    print_screen(VERDICT, warnings, blocks, [Block("more", ("x",) * 9)], ["Written to a."], verbose)
    return capsys.readouterr().out.splitlines()


def test_a_short_result_is_its_verdict(capsys):
    lines = printed(capsys)
    assert [line.partition(":")[0] for line in lines[:3]] == ["Accuracy", "Trust", "Next"]
    assert lines[-1] == "Written to a."


def test_what_has_no_room_is_named_and_shown_on_demand(capsys):
    blocks = [Block(f"block {number}", (f"line of {number}",) * 10) for number in range(5)]
    lines = printed(capsys, *blocks)
    assert len(lines) <= MAX_LINES
    assert lines.count("line of 0") == 10
    assert "line of 4" not in lines
    named = " ".join(lines)
    assert all(what in named for what in ("block 3", "block 4", "more", "--verbose"))
    assert "0.12 mm RMS, held out" in lines[-1]
    assert "yes" in lines[-1]
    whole = printed(capsys, *blocks, verbose=True)
    assert whole.count("line of 4") == 10
    assert whole.count("x") == 9


def test_a_command_without_verbose_names_another_way_to_what_has_no_room(capsys):
    result = ResultText(VERDICT, details=(Block("more", ("x",)),))
    print_result(result, elsewhere="--json")
    assert "Not shown: more (--json)." in capsys.readouterr().out


def test_warnings_are_never_hidden(capsys):
    warnings = [f"{kind} is odd" for kind in "abcdefghijklmnopqrstuvwxyz" * 2]
    lines = printed(capsys, Block("block", ("line",)), warnings=warnings)
    assert sum(line.startswith("Warning: ") for line in lines) == 26


@pytest.mark.parametrize(("count", "shown"), [(MAX_ALIKE, MAX_ALIKE), (MAX_ALIKE + 1, 1)])
def test_many_warnings_of_a_kind_become_one_with_their_lines(count, shown):
    warnings = [f"a.csv, line {2 + number}: is {number}.5 mm off." for number in range(count)]
    joined = merge_alike_warnings([*warnings, "something else."])
    assert len(joined) == shown + 1
    if shown == 1:
        assert joined[0].startswith(warnings[0])
        assert f"3 to {count + 1}" in joined[0]


def test_ranges_of_numbers():
    assert numbers_as_ranges([7, 3, 8, 9, 12]) == "3, 7 to 9, 12"


@pytest.mark.parametrize(
    ("value", "rows", "text"),
    [
        (0.07966, 1941, "0.0797"),
        (0.07966, 20, "0.080"),
        (123.4, 1941, "123"),
        (3e-7, 9, "< 0.0001"),
        (0.0, 9, "0"),
    ],
)
def test_errors_have_the_digits_that_they_deserve(value, rows, text):
    assert rounded_text(value, rows) == text


def test_a_sentence_continues_another():
    assert uncapitalised("Nothing moved.") == "nothing moved."
    assert uncapitalised("UR10 moved.") == "UR10 moved."


@pytest.mark.parametrize(
    ("what", "share", "step"),
    [
        ("cross-validation: fold 2 of 5: series 8", 0.2, "cross-validation: fold 2 of 5"),
        ("repeat 2 of 2, fold 1 of 4, calibration", 0.5, "repeat 2 of 2, fold 1 of 4"),
        ("12 of 4,200 candidates", None, "12 of 4,200 candidates"),
        ("calibration: gravity", None, "calibration"),
    ],
)
def test_steps_of_a_long_computation(what, share, step):
    assert completed_fraction(what) == share
    assert step_name(what) == step


def test_without_a_terminal_each_step_is_a_line_with_the_time_left(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress, "QUIET_S", 2.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with progress_of("calibrate") as tell:
        for number in range(1, 6):
            tell(f"fold {number} of 5: geometry")
            tell(f"fold {number} of 5: series")
            now[0] += 10.0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4  # the first fold begins before anybody waits
    assert lines[0].startswith("calibrate: fold 2 of 5")
    assert [line.split()[-3:-1] for line in lines] == [[str(left), "s"] for left in (40, 30, 20, 10)]


def test_a_quick_command_prints_no_progress(capsys, monkeypatch):
    monkeypatch.setattr(progress, "QUIET_S", 60.0)
    with progress_of("evaluate") as tell:
        tell("models")
    assert capsys.readouterr().err == ""

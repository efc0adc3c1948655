"""The page of `pisigma measure --view`."""

import sys

import pytest
from testing.models import no_type_checker
from testing.pages import visitor
from testing.sessions import arm_with_tracker, session_state

from pisigma.cli.measure.command import PageOptions, serve_session_page
from pisigma.files.errors import RobotError, missing_extra
from pisigma.robot.description import Robot

OPTIONS = PageOptions("127.0.0.1", 8080, None)


def test_without_the_option_nothing_is_served(capsys):
    with serve_session_page(arm_with_tracker(), None, None) as show:
        show(session_state(arm_with_tracker(), 3))
    assert capsys.readouterr() == ("", "")


def test_the_address_is_printed_with_the_results(capsys):
    pytest.importorskip("viser", reason="the extra view is not installed")
    arm = arm_with_tracker()
    with no_type_checker(), serve_session_page(arm, 0.15, OPTIONS) as show:
        out, err = capsys.readouterr()
        assert out == ""
        assert b"<html" in visitor(err.split()[-1]).ask().body
        show(session_state(arm, 3))
    assert "Ctrl-C" not in capsys.readouterr().err  # nobody could press it here


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError) as raised, serve_session_page(arm_with_tracker(), None, OPTIONS):
        pass
    assert 'pip install "pisigma[view]"' in str(missing_extra(raised.value))


def test_meshes_that_cannot_be_shown_are_refused(tmp_path):
    options = PageOptions("127.0.0.1", 8080, tmp_path / "absent.urdf")
    with (
        pytest.raises(RobotError, match=r"absent\.urdf"),
        serve_session_page(arm_with_tracker(), None, options),
    ):
        pass


def test_joint_values_in_json_have_units():
    with no_type_checker():
        figures = session_state(arm_with_tracker(Robot.load("kiro3")), 3).to_json()
    units = ["deg", "deg", "mm", "deg"]
    assert [joint["unit"] for joint in figures["coverage"]] == figures["next_pose"]["units"] == units

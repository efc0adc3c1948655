"""Known distances between sockets as the command line states them."""

import pytest

from pisigma.errors import IdentificationError
from pisigma.recipes.geometric_recipe import known_socket_distances

SOCKETS = ("left/0", "left/1", "right/0", "right/1", "right/0", "lonely/0")


def test_none_is_none():
    assert known_socket_distances(None, SOCKETS) == {}


def test_two_names():
    assert known_socket_distances("left/0, right/1, 120", SOCKETS) == {("left/0", "right/1"): 0.12}


def test_a_star_stands_for_the_same_text_in_both():
    wanted = {("left/0", "left/1"): 0.05, ("right/0", "right/1"): 0.05}
    assert known_socket_distances("*/0,*/1,50", SOCKETS) == wanted


@pytest.mark.parametrize(
    "stated", ["", "left/0,left/1", "left/0,left/1,far", "a,b,-1", "a,b,0", "a,b,inf", "a,b,1,2"]
)
def test_another_form_is_refused(stated):
    with pytest.raises(IdentificationError, match="as A,B,MM was wanted"):
        known_socket_distances(stated, SOCKETS)


def test_unknown_names_are_refused_with_those_there_are():
    with pytest.raises(IdentificationError, match=r"'up/0' and 'up/1'; there are left/0, left/1, right/0"):
        known_socket_distances("up/0,up/1,50", SOCKETS)

"""What has moved, in words."""

from pisigma.lifetime.recalibration.moved import Moved


def test_an_uncertainty_is_never_shown_as_zero():
    assert Moved("joint 3", 0.25, 1e-6, "deg").sentence == "joint 3 moved by 0.2500 ± 0.0001 deg"
    assert Moved("a_2", -1.2, 0.1, "mm").sentence == "a_2 moved by -1.20 ± 0.20 mm"

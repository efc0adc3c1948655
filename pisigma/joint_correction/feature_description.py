"""Features of a joint correction from their description, as models keep it."""

from collections.abc import Mapping
from typing import Any

from pisigma.errors import nearest_choice
from pisigma.joint_correction.features import (
    AbstractFeatures,
    ConditionFeatures,
    FourierSeries,
    GravityTorques,
    SharedFeatures,
)
from pisigma.robot.description import Robot

_NEEDED = {
    FourierSeries.name: {"harmonics"},
    GravityTorques.name: {"gravity"},
    ConditionFeatures.name: {"names", "mean", "spread", "gravity"},
    **{name: set[str]() for name in SharedFeatures.CHOICES},
}
"""What stands beside the name of features."""


def features_from(robot: Robot, description: Mapping[str, Any]) -> AbstractFeatures:
    """Features from what their `describe` gave.

    Args:
        robot: the nominal robot.
        description: "name", and what `describe` of the features of that name puts beside it.

    Raises:
        ValueError: there are no features of that name, or what they need is missing, too much or wrong.
    """
    name = str(description.get("name"))
    if name not in _NEEDED:
        raise ValueError(f"there are no features '{name}'; {nearest_choice(name, _NEEDED)}")
    needed = _NEEDED[name]
    if wrong := needed ^ (set(description) - {"name"}):
        raise ValueError(
            f"the features '{name}' need {sorted(needed) or 'a name only'}; see {sorted(wrong)}."
        )
    if name == FourierSeries.name:
        return FourierSeries(robot, description["harmonics"])
    if name in SharedFeatures.CHOICES:
        return SharedFeatures(robot, name)
    x, y, z = description["gravity"]
    if name == GravityTorques.name:
        return GravityTorques(robot, (x, y, z))
    names, mean, spread = (description[key] for key in ("names", "mean", "spread"))
    return ConditionFeatures(robot, names, mean, spread, (x, y, z))

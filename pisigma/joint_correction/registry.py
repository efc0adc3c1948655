"""The features of joint corrections by name: a line each, and `register_feature` for those from outside."""

from typing import Any

from pisigma.files.errors import nearest_choice
from pisigma.joint_correction.backlash import Backlash
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.coupled_series import CoupledSeries
from pisigma.joint_correction.feature import AbstractFeature, FeatureSection
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.shared_features import NominalPose, ScaledJoints, SinesCosines
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import register_compiled

FEATURES: dict[str, type[AbstractFeature]] = {}
"""All features by name, in the order in which they were registered."""


def register_feature(feature: type[AbstractFeature]) -> type[AbstractFeature]:
    """Make a feature known: calibrators and recipes may choose it, and models with it are read.

    It may decorate the class. A feature with a compiled form has the kernels made again where it is first used, which
    needs numba (`pip install 'pisigma[compile]'`).

    Raises:
        ValueError: another feature has the name.
    """
    if FEATURES.setdefault(feature.name, feature) is not feature:
        raise ValueError(f"there is a feature '{feature.name}' already; give yours another name.")
    if feature.compiled is not None:
        register_compiled(feature.name, feature.compiled)
    return feature


def feature_named(name: str) -> type[AbstractFeature]:
    """The feature of a name.

    Raises:
        ValueError: there is none.
    """
    if name not in FEATURES:
        raise ValueError(
            f"there are no features '{name}'; {nearest_choice(name, FEATURES)} One from outside the package needs its "
            "plug-in (--plugin FILE)."
        )
    return FEATURES[name]


def features_from_outside() -> tuple[str, ...]:
    """Names of the features that do not come with pisigma."""
    return tuple(name for name, feature in FEATURES.items() if feature.__module__.split(".")[0] != "pisigma")


def feature_section(value: Any) -> FeatureSection:
    """How a feature stands in the description of a model, from plain data.

    Args:
        value: a mapping with the key "name", and what else the section of the feature of that name has.

    Raises:
        ValueError: there is no such feature, or what it needs is missing, too much or wrong.
    """
    if isinstance(value, FeatureSection):
        return value
    name = value.get("name") if isinstance(value, dict) else None
    return feature_named(str(name)).section.model_validate(value)


def feature_from(robot: Robot, section: FeatureSection) -> AbstractFeature:
    """The feature that a section describes.

    Args:
        robot: the nominal robot.
        section: as `AbstractFeature.describe` gives it.

    Raises:
        ValueError: the values make no feature.
    """
    return feature_named(section.name).from_section(robot, section)


for _feature in (
    FourierSeries,
    GravityTorques,
    ConditionFeatures,
    Backlash,
    CoupledSeries,
    GearLines,
    ScaledJoints,
    SinesCosines,
    NominalPose,
):
    register_feature(_feature)

if __name__ == "__main__":
    from pisigma.robot.kernels.build import build

    build()

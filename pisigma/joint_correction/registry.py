"""Registry of the features of joint corrections by name; `register_feature` adds features of plug-ins."""

from typing import Any

from pisigma.files.errors import ModelError, choice_remedy
from pisigma.joint_correction.backlash import Backlash
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.coupled_series import CoupledSeries
from pisigma.joint_correction.feature import AbstractFeature, FeatureSection
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_torques import JointTorques
from pisigma.joint_correction.shared_features import NominalPose, ScaledJoints, SinesCosines
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import register_compiled

FEATURES: dict[str, type[AbstractFeature]] = {}
"""Classes of all features by name, in the order of registration."""


def register_feature(feature: type[AbstractFeature]) -> type[AbstractFeature]:
    """Register a feature, so that calibrators and recipes can use it and models with it can be loaded.

    May be used as a class decorator. The kernels are recompiled at the first use of a feature with a compiled form,
    which requires numba (`pip install 'pisigma[compile]'`).

    Raises:
        ValueError: a feature with this name is already registered.
    """
    if FEATURES.setdefault(feature.name, feature) is not feature:
        raise ValueError(f"a feature '{feature.name}' is already registered; choose another name.")
    if feature.compiled is not None:
        register_compiled(feature.name, feature.compiled)
    return feature


def feature_by_name(name: str) -> type[AbstractFeature]:
    """Return the class of the feature with the given name.

    Raises:
        ModelError: the feature is unknown.
    """
    if name not in FEATURES:
        hint = f"{choice_remedy(name, FEATURES)} Features of plug-ins need their plug-in (--plugin FILE)."
        raise ModelError(f"there is no feature '{name}'", value=name, remedy=hint)
    return FEATURES[name]


def plugin_features() -> tuple[str, ...]:
    """Return the names of the features that are not part of pisigma."""
    return tuple(name for name, feature in FEATURES.items() if feature.__module__.split(".")[0] != "pisigma")


def feature_section(value: Any) -> FeatureSection:
    """Validate the section of a feature in the description of a model.

    Args:
        value: mapping with the key "name" and the other keys of that feature's section.

    Raises:
        ValueError: the feature is unknown, or its keys are missing, unknown or invalid.
    """
    if isinstance(value, FeatureSection):
        return value
    name = value.get("name") if isinstance(value, dict) else None
    return feature_by_name(str(name)).section.model_validate(value)


def feature_from(robot: Robot, section: FeatureSection) -> AbstractFeature:
    """Return the feature that a section describes.

    Args:
        robot: the nominal robot.
        section: section as returned by `AbstractFeature.describe`.

    Raises:
        ValueError: the values are not valid for the feature.
    """
    return feature_by_name(section.name).from_section(robot, section)


for _feature in (
    FourierSeries,
    GravityTorques,
    JointTorques,
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
    from pisigma.robot.kernels.machine_code import build_object

    build()
    build_object()

"""Hybrid calibrations in a model folder: sections of `model.yaml`, and tensors.

The geometry is stored in `model.yaml` in mm and deg, for readers, and also in the weights file in SI units, so that
predictions are the same to the last bit after reading. `model.yaml` states the unknowns to which the rows of the
covariance root belong, in order.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.rounded_root import RoundedRoot
from pisigma.files.model_files import WEIGHTS
from pisigma.joint_correction.feature import AbstractFeature, angle_per_joint_value
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.registry import feature_from
from pisigma.measurement.sensors.sensor import UnknownGroup
from pisigma.model.calibrated_model import CalibratedModel, Frames
from pisigma.model.folder.model_document import (
    InconsistentFolderError,
    LearnedSection,
    ModelDocument,
    UncertaintySection,
    UnknownsSection,
)
from pisigma.robot.description import Robot

Shape = tuple[int | None, ...]
"""Expected shape of a tensor; None stands for any length."""

_ROUNDING = 1e-9
"""Largest difference [m or rad] between the geometry in `model.yaml` and in the weights file."""

DTYPES = {"coverage.joint": torch.int64, "rows.measured": torch.uint8, "uncertainty.numbers": torch.uint8}
"""Types of the tensors that are not float64."""

_GEOMETRY = ("dh", "base", "tool")


def hybrid_sections(model: CalibratedModel) -> dict[str, Any]:
    """Return the sections of `model.yaml` that only models of a hybrid calibration have."""
    result: dict[str, Any] = {}
    if (arm := model.hybrid) is not None:
        result["learned"] = {
            "features": [chosen.describe().model_dump(mode="json") for chosen in arm.correction.features],
            "orders": list(arm.correction.orders),
            "bases": {name: frame.tolist() for name, frame in model.hybrid_bases.items()},
            "tools": {name: frame.tolist() for name, frame in model.hybrid_tools.items()},
        }
    if (known := model.uncertainty) is not None:
        result["uncertainty"] = {
            "unknowns": [_unknowns_section(group) for group in known.space.unknowns],
            "values": {
                group: {owner: values.tolist() for owner, values in owners.items()}
                for group, owners in known.geometry.unknowns.items()
            },
            "free": [row for row in known.uncertain_unknowns if row < len(known.space.parameters)],
            "rounded": known.covariance_root.rounded is not None,
            "features": [chosen.name for chosen in known.features],
            "prior_scale": known.variance_factor,
            "noise": dict(known.noise.value),
            "stated_noise": None
            if known.noise.median_stated_sigma is None
            else dict(known.noise.median_stated_sigma),
        }
    return result


def hybrid_tensors(model: CalibratedModel) -> dict[str, Tensor]:
    """Return the tensors of the weights file that only models of a hybrid calibration have."""
    result: dict[str, Tensor] = {}
    if (nominal := model.nominal) is not None:
        result |= _geometry("drawn", nominal)
        result["drawn.limits"] = torch.from_numpy(nominal.limits[_limited(nominal)])
        assert model.calibrated is not None
        result |= _geometry("calibrated", model.calibrated)
    if (arm := model.hybrid) is not None:
        result |= _geometry("learned", arm.robot)
        result |= {f"correction.{key}": value for key, value in arm.correction.state_dict().items()}
        coverage = arm.coverage
        result |= {"coverage.joint": coverage.joint, "coverage.middle": coverage.middle}
        result["coverage.half"] = coverage.half_width
    if (known := model.uncertainty) is not None:
        if (rounded := known.covariance_root.rounded) is None:
            result["uncertainty.root"] = known.dense_root[known.uncertain_unknowns]
        else:
            rounded = rounded.select(known.uncertain_unknowns)
            result["uncertainty.unit"] = rounded.unit
            result["uncertainty.numbers"] = torch.frombuffer(bytearray(rounded.packed()), dtype=torch.uint8)
    return result


def check_size(document: ModelDocument, robot: Robot, stored_values: int) -> None:
    """Check that the file has enough values for the description, before weights are allocated.

    Args:
        document: description of the model.
        robot: robot of the description.
        stored_values: number of values in the weights file.

    Raises:
        InconsistentFolderError: the description requires more values.
    """
    required = sum(sum(group.orders) * len(group.inputs) * len(group.joints) for group in document.network)
    if (learned := document.learned) is not None:
        harmonics = sum(getattr(section, "harmonics", 0) for section in learned.features)
        required += robot.dof * (robot.dof * sum(learned.orders) + 2 * harmonics)
    if document.uncertainty is not None and InputProducts.name in document.uncertainty.features:
        required += robot.dof * math.comb(robot.dof, 2)
    if required > stored_values:
        raise InconsistentFolderError(
            f"the description requires at least {required:,} weights, but the file has {stored_values:,} numbers",
            column="orders",
            value=required,
        )


def hybrid_shapes(document: ModelDocument, robot: Robot) -> dict[str, Shape]:
    """Return the shapes of the tensors that a description requires.

    Raises:
        ValueError: features cannot be made as described, or the uncertainty refers to parameters that do not exist.
    """
    learned, known = document.learned, document.uncertainty
    if learned is None and known is None:
        return {}
    rows = len(robot.rows)
    result: dict[str, Shape] = {"drawn.limits": (int(_limited(robot).sum()), 2)}
    for name in ("drawn", "calibrated", *(["learned"] if learned else [])):
        result |= {f"{name}.dh": (rows, 5), f"{name}.base": (6,), f"{name}.tool": (6,)}
    weights = 0
    if learned is not None:
        empty = _empty_correction(learned, robot)
        result |= {f"correction.{key}": tuple(value.shape) for key, value in empty.state_dict().items()}
        result |= {f"coverage.{name}": (None,) for name in ("joint", "middle", "half")}
        if known is not None:
            weights = sum(int(chosen.used.sum()) for chosen in _weighted(known, empty))
    if known is not None:
        unknowns = len(known.free) + weights
        if not known.rounded:
            result["uncertainty.root"] = (unknowns, None)
        else:
            result |= {"uncertainty.unit": (unknowns,), "uncertainty.numbers": (None,)}
    return result


def with_hybrid(
    model: CalibratedModel, document: ModelDocument, tensors: Mapping[str, Tensor]
) -> CalibratedModel:
    """Return the model with the parts of a hybrid calibration and the exact geometry; leave other models unchanged.

    Args:
        model: model made from the description and all other tensors.
        document: description of the model.
        tensors: tensors with the shapes of `hybrid_shapes`.

    Raises:
        InconsistentFolderError: the parts do not fit together.
    """
    learned, known = document.learned, document.uncertainty
    if learned is None and known is None:
        return model
    if model.calibrated is None:
        raise InconsistentFolderError(
            "a hybrid calibration requires the calibrated robot", column="calibrated"
        )
    nominal = _with_limits(_exact("drawn", model.robot, tensors, ("dh",)), tensors["drawn.limits"])
    calibrated = _exact("calibrated", replace(model.calibrated, rows=nominal.rows), tensors, _GEOMETRY)
    robot = nominal.with_geometry(base=calibrated.base, tool=calibrated.tool)
    model = replace(model, robot=robot, calibrated=calibrated)
    place = (calibrated, model.bases, model.tools)
    if learned is not None:
        if (list(learned.bases), list(learned.tools)) != (list(model.bases), list(model.tools)):
            raise InconsistentFolderError(
                "the frames or targets of the learned part differ from those of the geometric part",
                column="learned",
            )
        place = (_exact("learned", nominal, tensors, ()), _frames(learned.bases), _frames(learned.tools))
        arm = HybridArm(place[0], _correction(learned, nominal, tensors), _coverage(nominal, tensors))
        model = replace(model, hybrid=arm, hybrid_bases=place[1], hybrid_tools=place[2])
    if known is None:
        return model
    uncertainty = _uncertainty(known, model.hybrid, nominal, tensors, place)
    return replace(model, uncertainty=uncertainty)


def _limited(robot: Robot) -> np.ndarray:
    """Return the mask of the joints with limits; a file states both limits of a joint or neither."""
    result: np.ndarray = np.isfinite(robot.limits).all(1)
    return result


def _geometry(name: str, robot: Robot) -> dict[str, Tensor]:
    return {f"{name}.{part}": torch.from_numpy(getattr(robot, part).copy()) for part in _GEOMETRY}


def _exact(name: str, robot: Robot, tensors: Mapping[str, Tensor], same: Sequence[str]) -> Robot:
    """Return the robot with the geometry of the weights file; parts in `same` must agree with the description."""
    values = {part: tensors[f"{name}.{part}"].numpy() for part in _GEOMETRY}
    for part in same:
        if np.abs(values[part] - getattr(robot, part)).max() > _ROUNDING:
            raise InconsistentFolderError(
                f"the tensor '{name}.{part}' differs from the geometry in the description",
                file=WEIGHTS,
                value=f"{name}.{part}",
            )
    return robot.with_geometry(**values)


def _with_limits(robot: Robot, limits: Tensor) -> Robot:
    """Return the robot with the exact joint limits of the weights file."""
    limited = _limited(robot)
    if len(limits) and np.abs(limits.numpy() - robot.limits[limited]).max() > _ROUNDING:
        raise InconsistentFolderError(
            "the tensor 'drawn.limits' differs from the joint limits in the description",
            file=WEIGHTS,
            value="drawn.limits",
        )
    rows = list(robot.rows)
    places = [row for row, bounded in zip(robot.joint_rows, limited, strict=True) if bounded]
    for place, (lower, upper) in zip(places, limits.tolist(), strict=True):
        rows[place] = replace(rows[place], lower=lower, upper=upper)
    return replace(robot, rows=tuple(rows))


def _frames(sections: Mapping[str, tuple[float, ...]]) -> Frames:
    return {name: np.array(frame) for name, frame in sections.items()}


def _empty_correction(learned: LearnedSection, robot: Robot) -> JointCorrection:
    features = [feature_from(robot, section) for section in learned.features]
    return JointCorrection(robot, features, learned.orders)


def _correction(learned: LearnedSection, robot: Robot, tensors: Mapping[str, Tensor]) -> JointCorrection:
    correction, prefix = _empty_correction(learned, robot), "correction."
    own = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    correction.load_state_dict(own)
    correction.requires_grad_(False)
    return correction


def _coverage(robot: Robot, tensors: Mapping[str, Tensor]) -> JointCoverage:
    joint, middle, half = (tensors[f"coverage.{name}"] for name in ("joint", "middle", "half"))
    if not len(joint) == len(middle) == len(half):
        raise InconsistentFolderError(
            "the coverage has intervals without joint, middle or half width", file=WEIGHTS, value="coverage"
        )
    if set(joint.tolist()) != set(range(robot.dof)) or bool((half < 0).any()):
        raise InconsistentFolderError(
            "the coverage must have an interval of width >= 0 for every joint of the robot, and no other",
            file=WEIGHTS,
            value="coverage.joint",
        )
    rate = torch.from_numpy(angle_per_joint_value(robot))
    turning = tuple(bool(is_revolute) for is_revolute in robot.revolute)
    return JointCoverage(joint, middle, half, rate, turning)


def _uncertainty(
    known: UncertaintySection,
    hybrid: HybridArm | None,
    nominal: Robot,
    tensors: Mapping[str, Tensor],
    place: tuple[Robot, Frames, Frames],
) -> PositionUncertainty:
    """Return the uncertainty, with zero rows of the root for parameters that were not free."""
    robot, bases, tools = place
    groups = [_unknowns(section) for section in known.unknowns]
    if len({group.name for group in groups}) < len(groups):
        raise InconsistentFolderError(
            "a group of sensor unknowns appears twice", column="uncertainty.unknowns"
        )
    if elsewhere := {frame for group in groups for frame in group.frames} - {*bases}:
        raise InconsistentFolderError(
            f"sensor unknowns refer to the frame '{min(elsewhere)}', which the model does not have",
            column="uncertainty.unknowns",
            value=min(elsewhere),
        )
    space = ParameterSpace(nominal, tuple(bases), tuple(tools), tuple(groups))
    count, free = len(space.parameters), list(known.free)
    if sorted(set(free)) != free or (free and free[-1] >= count):
        raise InconsistentFolderError(
            f"expected increasing indices of free parameters below {count}, got {free}",
            column="uncertainty.free",
            value=free,
        )
    unknowns = {
        group: {owner: np.array(values) for owner, values in owners.items()}
        for group, owners in known.values.items()
    }
    for own in space.unknowns:
        wrong = {len(values) for values in unknowns.get(own.name, {}).values()} - {len(own.columns)}
        if wrong:
            raise InconsistentFolderError(
                f"expected {len(own.columns)} values of every {own.name}, got {(count := wrong.pop())}",
                column="uncertainty.values",
                value=count,
            )
    geometry = IdentifiedGeometry(robot, bases, tools, unknowns)
    features = _weighted(known, None if hybrid is None else hybrid.correction)
    noise = CalibrationNoise(known.noise, known.stated_noise)
    root = _root(known, tensors, free, count)
    return PositionUncertainty(space, geometry, features, root, known.variance_factor, noise)


def _root(
    known: UncertaintySection, tensors: Mapping[str, Tensor], free: list[int], parameters: int
) -> CovarianceRoot:
    """Make the covariance root of all unknowns, with rows of zeros for parameters that were not free."""
    rows = tensors["uncertainty.unit" if known.rounded else "uncertainty.root"]
    count = parameters + len(rows) - len(free)
    uncertain = [*free, *range(parameters, count)]
    if not known.rounded:
        full = rows.new_zeros(count, rows.shape[1])
        full[uncertain] = rows
        return CovarianceRoot(full)
    try:
        content = tensors["uncertainty.numbers"].numpy().tobytes()
        rounded = RoundedRoot.unpacked(content, rows)
    except ValueError as problem:
        raise InconsistentFolderError(str(problem), file=WEIGHTS, value="uncertainty.numbers") from None
    return CovarianceRoot.from_rounded(rounded.with_exact_unknowns(uncertain, count))


def _unknowns_section(group: UnknownGroup) -> dict[str, object]:
    """Return the section of the unknown parameters of one kind of sensor."""
    return {
        "name": group.name,
        "columns": list(group.columns),
        "owners": list(group.owners),
        "frames": list(group.frames),
        "angles": sorted(group.angles),
        "units": dict(group.units),
    }


def _unknowns(section: UnknownsSection) -> UnknownGroup:
    if len(section.frames) not in (0, len(section.owners)):
        raise InconsistentFolderError(
            f"expected one frame for every {section.name}, got {len(section.frames)}",
            column="uncertainty.unknowns",
            value=len(section.frames),
        )
    return UnknownGroup(
        section.name,
        section.columns,
        section.owners,
        section.frames,
        frozenset(section.angles),
        section.units,
    )


def _weighted(known: UncertaintySection, correction: JointCorrection | None) -> tuple[AbstractFeature, ...]:
    """Return the features whose weights are in the root, including the input products of the product units.

    Raises:
        InconsistentFolderError: the features differ from those of the learned part.
    """
    learned = () if correction is None else correction.features
    of_name = {chosen.name: chosen for chosen in learned}
    if correction is not None and InputProducts.name in known.features:
        of_name[InputProducts.name] = InputProducts(correction.robot)
    if sorted(known.features) != sorted(of_name):
        raise InconsistentFolderError(
            f"the uncertainty refers to the features {', '.join(known.features) or 'none'}, "
            f"but the learned part has {', '.join(chosen.name for chosen in learned) or 'none'}",
            column="uncertainty.features",
            value=list(known.features),
        )
    return tuple(of_name[name] for name in known.features)

"""Interface of error sources, which are recipe sections that change the geometry or the joint values of a robot."""

import functools
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, Union

import numpy as np
from jaxtyping import Float64
from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler, TypeAdapter
from pydantic_core import CoreSchema, core_schema
from torch import Tensor

from pisigma.files.errors import RecipeError, choice_remedy
from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot

Value = TypeVar("Value")

JointErrorFunction = Callable[[Tensor], Tensor]
"""Function that maps commanded joint values `(*batch, dof)` to joint errors [rad or m] of the same shape."""


@dataclass(frozen=True, eq=False)
class GeometryChange:
    """Errors of the geometric parameters of a robot; columns as in `DH_COLUMNS` and `FRAME_COLUMNS`.

    Attributes:
        dh: errors of the DH rows `(rows, 5)` [rad or m].
        base: errors of x, y, z [m], roll, pitch, yaw [rad] of the base.
        tool: errors of x, y, z [m], roll, pitch, yaw [rad] of the tool.
    """

    dh: Float64[np.ndarray, "rows 5"]
    base: Float64[np.ndarray, " 6"]
    tool: Float64[np.ndarray, " 6"]


class AbstractErrorSource(Section, ABC):
    """Base class of error sources: `AbstractGeometrySource`, `AbstractJointSource` and `AbstractPlaySource`.

    Attributes:
        kind: name of the source in recipes, a `Literal` of one text.
    """

    kind: str


class AbstractGeometrySource(AbstractErrorSource):
    """Base class of sources that change geometric parameters; the changes of several sources are added."""

    @abstractmethod
    def parameter_errors(self, robot: Robot, place_in_recipe: str) -> GeometryChange:
        """Return the errors of the geometric parameters of the nominal robot.

        Args:
            robot: the nominal robot.
            place_in_recipe: position of the source in its recipe, for messages.

        Raises:
            RecipeError: the source does not fit the robot.
        """


class AbstractJointSource(AbstractErrorSource):
    """Base class of sources that change commanded joint values; the errors of several sources are added."""

    @property
    def stepped_joints(self) -> frozenset[str]:
        """Names of the joints that have encoder steps due to this source and so cannot reach arbitrary values."""
        return frozenset()

    @abstractmethod
    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the errors as a function of the commanded joint values of one robot.

        Args:
            robot: the nominal robot.
            place_in_recipe: position of the source in its recipe, for messages.

        Raises:
            RecipeError: the source does not fit the robot.
        """


class AbstractPlaySource(AbstractErrorSource):
    """Base class of sources of backlash, with which joints stop on their side of approach; their plays are added.

    Attributes:
        seed: random seed of the directions of approach of simulated rows.
    """

    seed: int

    @abstractmethod
    def half_play(self, robot: Robot, place_in_recipe: str) -> Float64[np.ndarray, " dof"]:
        """Return the distance by which every joint stops short of the commanded value [rad or m].

        Args:
            robot: the nominal robot.
            place_in_recipe: position of the source in its recipe, for messages.

        Raises:
            RecipeError: the source does not fit the robot.
        """


def row_index(robot: Robot, name: str, place_in_recipe: str) -> int:
    """Return the index of the row `name`.

    Args:
        robot: the robot.
        name: name of the row.
        place_in_recipe: position in the recipe, for messages.

    Raises:
        RecipeError: the robot has no such row; the message states the nearest name.
    """
    return _index(robot, [row.name for row in robot.rows], name, "row", place_in_recipe)


def joint_index(robot: Robot, name: str, place_in_recipe: str) -> int:
    """Return the index of the joint `name` among the rows that are not fixed; see `row_index`."""
    return _index(robot, [joint.name for joint in robot.joints], name, "joint", place_in_recipe)


def _index(robot: Robot, names: list[str], name: str, what: str, place: str) -> int:
    if name not in names:
        raise RecipeError(
            f"robot '{robot.name}' has no {what} '{name}'",
            option=place,
            value=name,
            remedy=choice_remedy(name, names),
        )
    return names.index(name)


def values_by_joint_index(
    robot: Robot,
    revolute_values: Mapping[str, Value],
    prismatic_values: Mapping[str, Value],
    field_names: tuple[str, str],
    place_in_recipe: str,
    by_axis_name: bool = False,
) -> dict[int, Value]:
    """Return the values of two mappings in a recipe by joint index.

    Args:
        robot: the robot.
        revolute_values: values of revolute joints, by name.
        prismatic_values: values of prismatic joints, by name.
        field_names: keys of the two mappings in the recipe, revolute first.
        place_in_recipe: position in the recipe, for messages.
        by_axis_name: whether the mappings are by names of the controller's axes, `robot.axes`, instead of joints.

    Raises:
        RecipeError: a joint is unknown, or is in the mapping for the other joint type.
    """
    values: dict[int, Value] = {}
    joints = robot.axes if by_axis_name else robot.joints
    kinds = ((revolute_values, *field_names, "revolute"), (prismatic_values, *field_names[::-1], "prismatic"))
    for mapping, field, other, kind in kinds:
        for name, value in mapping.items():
            index = _index(robot, [joint.name for joint in joints], name, "joint", place_in_recipe)
            actual = joints[index].type
            if actual != kind:
                raise RecipeError(
                    f"joint '{name}' in {field} is {actual}",
                    option=place_in_recipe,
                    value=name,
                    remedy=f"move it to {other}",
                )
            values[index] = value
    return values


def value_per_joint(
    robot: Robot,
    revolute_values: Mapping[str, float],
    prismatic_values: Mapping[str, float],
    field_names: tuple[str, str],
    place_in_recipe: str,
) -> Float64[np.ndarray, " dof"]:
    """Return one value per joint [rad or m], 0 if not stated; see `values_by_joint_index`."""
    stated = values_by_joint_index(robot, revolute_values, prismatic_values, field_names, place_in_recipe)
    return np.array([stated.get(index, 0.0) for index in range(robot.dof)])


def amplitude_of(
    robot: Robot, joint: str, deg: float | None, mm: float | None, place_in_recipe: str
) -> Float64[np.ndarray, " dof"]:
    """Return one value per joint: the amplitude of a wave [rad or m] for its joint, 0 for other joints.

    Args:
        robot: the robot.
        joint: name of the joint with the error.
        deg: amplitude of a revolute joint [deg].
        mm: amplitude of a prismatic joint [mm].
        place_in_recipe: position in the recipe, for messages.
    """
    stated = value_per_joint(
        robot,
        {} if deg is None else {joint: deg},
        {} if mm is None else {joint: mm},
        ("amplitude_deg", "amplitude_mm"),
        place_in_recipe,
    )
    return np.where(robot.revolute, np.deg2rad(stated), stated / 1e3)


@dataclass(frozen=True, eq=False)
class RegisteredSection:
    """Annotation of a value that is a section of a registry, selected by its `kind`.

    `Annotated[AbstractErrorSource, OneOf(ERROR_SOURCES)]` reads `{kind: encoder, ...}` as the section that is
    registered as "encoder". Sections may be registered later; errors list those registered at the time of reading.

    Attributes:
        registry: two or more section classes by kind.
    """

    registry: Mapping[str, type[Section]]

    def _sections(self) -> Any:  # a TypeAdapter, which beartype does not accept as a type
        return _one_of(tuple(self.registry.values()))

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Validate with the sections that are registered at the time of reading."""
        plain = core_schema.no_info_plain_validator_function
        return core_schema.json_or_python_schema(plain(self._from_json), plain(self._from_python))

    def _from_json(self, value: Any) -> Any:
        return self._sections().validate_json(json.dumps(value), strict=True)

    def _from_python(self, value: Any) -> Any:
        return value if isinstance(value, Section) else self._sections().validate_python(value)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON schema of the sections that are registered now."""
        return handler(self._sections().core_schema)


@functools.lru_cache(maxsize=64)
def _one_of(sections: tuple[type[Section], ...]) -> Any:
    any_of: Any = Annotated[Union[sections], Field(discriminator="kind")]  # noqa: UP007
    return TypeAdapter(any_of)

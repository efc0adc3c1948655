"""Figures of several arms: bases relative to each other, shared objects, and whether the arms agree on these."""

import math
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from pisigma.calibration.frames.arm_bases import ArmBases, Disagreement
from pisigma.calibration.frames.shared_objects import TOUCH, Postures
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.yaml_file import Section, StoredFigures
from pisigma.robot.se3 import xyz_zyx_from_transform
from pisigma.validation.held_out.diagnostic import Diagnostic

Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]


class ArmBaseFigures(StoredFigures):
    """Base of an arm relative to the base of another arm, both as in their calibrated models.

    A base includes the errors of the height and zero of the first joint, which rows cannot separate from it; standard
    errors do not include the difference from the mounting of the arm.

    Attributes:
        arm: name of the arm.
        other_arm: name of the other arm.
        x_mm: position of the base along x [mm].
        y_mm: position along y [mm].
        z_mm: position along z [mm].
        roll_deg: rotation about z, the first of three [deg].
        pitch_deg: rotation about the new y axis [deg].
        yaw_deg: rotation about the new x axis [deg].
        standard_errors: standard errors of a shift of the base along x, y, z [mm] and of a rotation about x, y, z
            [deg]; the axes are those of the other arm's base.
        covariance: covariance of the same six values [mm and deg].
        tool_to_tool_mm: RMS standard deviation of the vector from the tool of the other arm to that of this one [mm],
            over pairs of measured postures.
    """

    arm: str
    other_arm: Annotated[str, Field(alias="in_base_of")]
    x_mm: float
    y_mm: float
    z_mm: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    standard_errors: Six
    covariance: tuple[Six, Six, Six, Six, Six, Six]
    tool_to_tool_mm: float


class SharedFigures(StoredFigures):
    """A frame or point that several arms measured under one name, or a touch of two arms.

    Attributes:
        kind: "joint" (of a torso), "frame", "socket", "anchor" or "touch".
        name: its name.
        arms: names of the arms.
        largest_disagreement_mm: largest distance between its positions (of a joint, between its axes) according to two
            arms [mm]; 0 if it only served to determine the bases.
    """

    kind: str
    name: str
    arms: tuple[str, ...]
    largest_disagreement_mm: Annotated[float, Field(alias="distance_mm")]


class TipFigures(Section):
    """A touching tip that no target of the arm's own rows is.

    Attributes:
        arm: name of the arm.
        name: its name in the column `target`.
        x_mm: position on the last row of the arm along x [mm].
        y_mm: position along y [mm].
        z_mm: position along z [mm].
        standard_errors: standard errors of x, y, z [mm].
    """

    arm: str
    name: str
    x_mm: float
    y_mm: float
    z_mm: float
    standard_errors: Three


class ArmModelFolder(Section):
    """Model folder of an arm.

    Attributes:
        name: name of the arm and of its folder next to `frames.yaml`.
        robot: name of the robot.
        torso: first joints of the arm, which it shares with other arms of one torso.
        sha256: hash of the folder, see `pisigma.files.model_files.model_hash`; empty before it is written.
    """

    name: str
    robot: str
    torso: tuple[str, ...] = ()
    sha256: str = ""


class ArmsSummary(StoredFigures):
    """All figures of several arms, as in `frames.yaml`.

    Attributes:
        arms: the arms with their models.
        bases: base of every arm relative to that of every arm listed before it.
        shared: objects that the arms share.
        tips: touching tips that no target of the rows is.
        misfit: sum of the squared differences between the arms in units of their standard deviations.
        degrees_of_freedom: number of independent differences that the bases do not absorb.
        misfit_probability: probability of a larger misfit of arms without faults.
        diagnostics: findings about objects on which the arms disagree.
        indeterminate_sums: directions of the bases that are known only in a sum with parameters of a tool, one sentence
            each.
    """

    arms: tuple[ArmModelFolder, ...]
    bases: tuple[ArmBaseFigures, ...]
    shared: tuple[SharedFigures, ...]
    misfit: float
    degrees_of_freedom: Annotated[int, Field(alias="redundancy")]
    misfit_probability: Annotated[float, Field(alias="probability")]
    tips: tuple[TipFigures, ...] = ()
    diagnostics: tuple[Diagnostic, ...] = ()
    indeterminate_sums: Annotated[tuple[str, ...], Field(alias="sums")] = ()

    def to_json(self) -> dict[str, Any]:
        """Return all figures as JSON values, by name."""
        return self.model_dump(mode="json", by_alias=True)


def base_figures(
    bases: ArmBases, first_arm: int, second_arm: int, postures: tuple[Postures, ...]
) -> ArmBaseFigures:
    """Return the base of the second arm relative to that of the first; `postures` are those of every arm."""
    T, covariance = bases.relative(first_arm, second_arm)
    shown = np.array([1e3] * 3 + [math.degrees(1)] * 3)
    in_mm_and_deg = covariance.numpy() * shown * shown[:, None]
    names = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")
    values = dict(zip(names, (xyz_zyx_from_transform(T).numpy() * shown).tolist(), strict=True))
    return ArmBaseFigures(
        arm=bases.individual_posteriors[second_arm].name,
        other_arm=bases.individual_posteriors[first_arm].name,
        standard_errors=tuple(np.sqrt(in_mm_and_deg.diagonal()).tolist()),
        covariance=tuple(map(tuple, in_mm_and_deg.tolist())),
        tool_to_tool_mm=bases.tool_to_tool_sigma(first_arm, second_arm, postures) * 1e3,
        **values,
    )


def tip_figures(bases: ArmBases) -> tuple[TipFigures, ...]:
    """Return the tips that were found together with the bases."""
    first, sizes = 6 * (len(bases.individual_posteriors) - 1), [3] * len(bases.tips)
    roots = torch.split(bases.conditioned.x_root[first:], sizes) if sizes else ()
    return tuple(
        TipFigures(
            arm=bases.individual_posteriors[number].name,
            name=name,
            **dict(zip(("x_mm", "y_mm", "z_mm"), (position * 1e3).tolist(), strict=True)),
            standard_errors=tuple((root.norm(dim=1) * 1e3).tolist()),
        )
        for ((number, name), position), root in zip(bases.tips.items(), roots, strict=True)
    )


def disagreement_diagnostic(bases: ArmBases, disagreement: Disagreement) -> Diagnostic:
    """Return the finding that arms disagree on the location of a shared object."""
    names = " and ".join(
        f"'{bases.individual_posteriors[number].name}'" for number in disagreement.shared.arms
    )
    remedy = (
        "check the names and joint values of both rows, and that both tips were at rest"
        if disagreement.shared.kind == TOUCH
        else "check that it was not moved between the measurements of the arms, and that its name is right in "
        "all rows, and check the rows of both arms"
    )
    return Diagnostic(
        kind="arms",
        severity="implausible",
        cause=disagreement.shared.kind,
        sentence=(
            f"Arms {names} place {disagreement.shared.kind} '{disagreement.shared.name}' "
            f"{disagreement.distance * 1e3:.3g} mm apart, which is improbable "
            f"(probability {disagreement.p_value:.1g}); {remedy}."
        ),
        values={
            "name": disagreement.shared.name,
            "distance_mm": disagreement.distance * 1e3,
            "probability": disagreement.p_value,
        },
        remedy=remedy,
    )


def indeterminate_sum_sentences(arm: str, result: CalibrationResult) -> tuple[str, ...]:
    """Return a sentence for every direction of an arm's bases that is known only in a sum with tool parameters."""
    in_a_sum = {one.name for one in result.parameters if one.short_remark.startswith("in a sum")}
    return tuple(
        f"{one.names[0]} of arm '{arm}' is known only in a sum with {', '.join(one.names[1:])}; errors of these shift "
        "or turn its base relative to other arms, and the standard errors do not include them."
        for one in result.redundancy.dependencies
        if one.names[0].startswith("base_")
        and one.names[0] in in_a_sum
        and any(name.startswith("tool_") for name in one.names[1:])
    )


def arms_summary(
    bases: ArmBases,
    robots: tuple[str, ...],
    postures: tuple[Postures, ...],
    indeterminate_sums: tuple[str, ...],
) -> ArmsSummary:
    """Collect the figures of several arms.

    Args:
        bases: the arms with their bases.
        robots: names of their robots.
        postures: postures of every arm.
        indeterminate_sums: sentences of `indeterminate_sum_sentences` of all arms.
    """
    names = [arm.name for arm in bases.individual_posteriors]
    count = len(names)
    return ArmsSummary(
        arms=tuple(
            ArmModelFolder(name=arm.name, robot=robot, torso=arm.torso_joints)
            for arm, robot in zip(bases.individual_posteriors, robots, strict=True)
        ),
        bases=tuple(base_figures(bases, a, b, postures) for b in range(count) for a in range(b)),
        shared=tuple(
            SharedFigures(
                kind=one.kind,
                name=one.name,
                arms=tuple(names[number] for number in one.arms),
                largest_disagreement_mm=distance * 1e3,
            )
            for one, distance in zip(bases.shared, bases.largest_distances, strict=True)
        ),
        misfit=bases.conditioned.misfit,
        degrees_of_freedom=bases.conditioned.degrees_of_freedom,
        misfit_probability=bases.p_value,
        tips=tip_figures(bases),
        diagnostics=tuple(disagreement_diagnostic(bases, one) for one in bases.disagreements),
        indeterminate_sums=indeterminate_sums,
    )

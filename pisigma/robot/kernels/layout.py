"""The structs for an arm and for working memory, to which the kernels get one pointer each.

Arrays have the length that the largest robot needs, and counts, so that one compiled function serves all robots.
"""

from typing import Any

import numpy as np

from pisigma.files.errors import ModelError
from pisigma.robot.kernels.arrays import PARTS, Description
from pisigma.robot.kernels.forms import MAX_JOINTS, MAX_KINDS, MAX_VALUES, KernelForms

DOF = MAX_JOINTS
ROWS, FACTORS, UNITS, STRETCHES, STARTS = 24, 24, 12, 96, 512
"""Largest numbers of rows, of factors and product units, of measured intervals, and of starts."""
BRANCHES, CANDIDATES = 8, 16
"""Largest numbers of branches of a closed form, and of joint values that are stored as starts of a search."""
INPUTS = 2 * DOF
"""Largest number of inputs of product units."""
GROUPS, SEEN, GROUP_INPUTS, SAMPLES, ENTRIES = 8, 512, 80, 2048, 2048 * 320
"""Largest numbers of groups of a network, of inputs of all groups and of one group, of rows of a domain, and of
entries of these rows."""

LANES = 16
"""Number of poses whose forward kinematics is vectorised."""

_Field = tuple[str, Any, tuple[int, ...]]


def _floats(**shapes: tuple[int, ...]) -> list[_Field]:
    return [(name, np.float64, shape) for name, shape in shapes.items()]


def _integers(**shapes: tuple[int, ...]) -> list[_Field]:
    return [(name, np.int64, shape) for name, shape in shapes.items()]


_ARMS = _integers(dof=(), rows_used=(), corrected=(), kind=(ROWS,), revolute=(DOF,)) + _floats(
    rows=(3, ROWS, 9), ends=(3, 2, 3, 4), reach=(3,), direction=(DOF,), limits=(DOF, 2)
)
_CORRECTION = _integers(
    inputs=(), products=(), frames=(), periodic=(), orders=(UNITS,), first=(MAX_KINDS,)
) + _floats(
    rate=(DOF,),
    middle=(DOF,),
    half=(DOF,),
    values=(MAX_VALUES,),
    weight=(FACTORS, INPUTS, DOF),
    bias=(FACTORS, DOF),
)
_COVERAGE = _integers(stretches=(), joint=(STRETCHES,)) + _floats(
    middle=(STRETCHES,), half=(STRETCHES,), rate=(DOF,)
)
_NETWORK = _integers(
    used=(),
    inputs=(),
    samples=(),
    columns=(),
    coarse=(),
    column=(SEEN,),
    source=(SEEN,),
    first=(GROUPS + 1,),
    products=(GROUPS,),
    orders=(GROUPS, UNITS),
    group=(DOF,),
) + _floats(
    factors=(SEEN, DOF),
    offset=(SEEN,),
    scale=(SEEN,),
    reference=(GROUPS, 3, 3),
    weight=(DOF, FACTORS, GROUP_INPUTS),
    bias=(DOF, FACTORS),
    output_offset=(DOF,),
    output_scale=(DOF,),
    centre=(DOF,),
    times=(SEEN,),
    rows=(ENTRIES,),
    radius=(),
)
_CLOSED_FORM = _integers(kind=(), branches=(), trained=(), order=(BRANCHES,)) + _floats(
    first=(3, 4), last=(3, 4), sign=(DOF,), direction=(DOF,), offset=(DOF,), theta=(DOF,), d=(DOF,), a=(DOF,)
)
_STARTS = _integers(count=()) + _floats(q=(STARTS, DOF), points=(STARTS, 12), lever=())

_STRUCTS = (_ARMS, _CORRECTION, _COVERAGE, _NETWORK, _CLOSED_FORM, _STARTS)
DESCRIPTION = np.dtype([(part, np.dtype(fields)) for part, fields in zip(PARTS, _STRUCTS, strict=True)])
"""Struct with the description of an arm for the kernels: the fields of `kernels.arrays`, and counts."""

MEMORY = np.dtype(
    _floats(
        pose=(4, 4),  # the target pose
        near=(DOF,),  # reference joint values
        approach=(DOF,),  # approach direction of every joint: +1 or -1, 0 if not stated
        rounding=(),  # relative size of rounding errors of the target poses
        solution=(DOF,),  # joint values found
        nominal=(DOF,),  # joint values of the nominal arm
        axes=(DOF, 6),  # direction and origin of the joint axes
        T=(3, 4),  # pose and Jacobian of an arm
        J=(7, DOF),
        R=(3, 3),
        error=(7,),  # error of the pose at a trial step, and of the elbow angle
        best=(7,),  # error of the pose at the best joint values so far, and the Jacobian there
        J_best=(7, DOF),
        trial=(DOF,),
        theta=(DOF,),  # joint values with correction
        delta=(DOF,),  # joint correction, and the slope of its series
        slope=(DOF,),
        step=(DOF,),
        turning=(2, DOF),  # sines and cosines of the joint angles
        phi=(INPUTS,),  # inputs of product units
        frames=(DOF, 18),  # frames for gravity torques
        scaled=(7, DOF),  # dimensionless Jacobian, normal equations and their right side
        square=(7, 7),
        right=(7,),
        scale=(
            DOF,
        ),  # joint motion [rad or m] per unit of the columns of the scaled Jacobian; 0 for a joint that is fixed now
        branches=(BRANCHES, DOF),  # closed-form joint values of all branches
        others=(BRANCHES, DOF),  # closed-form joint values for other poses, or the nearest values of branches
        wanted=(4, 4),  # a pose in the frames of the closed form
        q=(DOF,),  # joint values of a candidate
        start=(DOF,),  # joint values to start from
        kept=(DOF,),  # joint values outside their limits, used if there are no others
        checked=(DOF,),  # joint values of T, J and error, NaN if these are not valid
        lanes=(12, LANES),  # frames of many poses, entry by entry
        lane_turns=(2, LANES),  # cosines and sines of the angles of a joint
        lane_axes=(DOF, 6, LANES),  # directions and origins of the joints
        seen=(SEEN,),  # scaled inputs of a network
        angles=(3,),  # roll, pitch and yaw
        tolerance=(6,),  # tolerances of the axes of the tool, see `kinematics.task_axes.TaskAxes.row`
        weight=(6,),  # weights of these axes in least squares
        turned=(6,),  # pose error in these axes
        elbow=(),  # requested elbow angle, NaN if it is free, and the intermediate angle of a search
        elbow_now=(),
        line=(3,),  # from shoulder to wrist, with the vectors upright, bend and lateral
        upright=(3,),
        bend=(3,),
        lateral=(3,),
        level=(4, 4),  # the target pose, modified for the nominal arm
        candidates=(CANDIDATES, DOF),  # joint values of starts, the most promising first
        rank=(CANDIDATES,),
        preferred=(DOF,),  # preferred joint values of a redundant arm
        chosen=(DOF,),  # the best of several solutions
        first=(DOF,),  # initial joint values of a search
        distance=(SAMPLES,),  # squared distances from rows of a domain, or from stored poses
    )
    + _integers(
        nearest=(128,),  # indices of the stored starts with the nearest poses
        whole=(),  # 1 if all six axes are exact, else 0
        loose=(),  # 1 if the arm has too few joints for all axes, which are then weighted by tolerances
        pivot=(),  # the axis about which rotations are split into twist and swing, or -1
        rows=(),  # number of axes in use
        height=(),  # 6, or 7 with the elbow angle
    )
)
"""Working memory of the kernels; nothing in it is kept from one pose to the next."""


def pack(description: Description, name: str, forms: KernelForms) -> np.ndarray:
    """Pack a description into one struct, `(1,)` of `DESCRIPTION`.

    Args:
        description: the arm as arrays.
        name: name of the model for messages.
        forms: features and closed forms that the kernels evaluate.

    Raises:
        ModelError: the arm is larger than the compiled kernels allow, or needs a form that they do not evaluate.
    """
    packed = np.zeros(1, DESCRIPTION)
    for part, kind in PARTS.items():
        for field in (name for name in kind._fields if name in (packed[part].dtype.names or ())):
            value = np.asarray(getattr(getattr(description, part), field))
            room = packed[part][field][0]
            if value.ndim != np.ndim(room) or any(
                n > most for n, most in zip(value.shape, room.shape, strict=True)
            ):
                raise ModelError(
                    f"model '{name}': {part}.{field} has the shape {value.shape}, but the compiled kernels allow "
                    f"at most {np.shape(room)}",
                    expected=f"{part}.{field} of shape {np.shape(room)} or smaller",
                    value=value.shape,
                    remedy="use pisigma.load",
                )
            packed[part][field][(0, *(slice(n) for n in value.shape))] = value
    arms, correction = description.arms, description.correction
    packed["arms"]["dof"], packed["arms"]["rows_used"] = len(arms.direction), len(arms.kind)
    packed["correction"]["half"][0, len(arms.direction) :] = 1.0
    packed["correction"]["inputs"] = correction.weight.shape[1]
    packed["correction"]["products"] = len(correction.orders)
    packed["correction"]["first"] = -1
    wanted = description.forms
    if not forms.cover(wanted):
        lacking = {*wanted.features, *wanted.closed_forms} - {*forms.features, *forms.closed_forms}
        raise ModelError(
            f"model '{name}' uses {', '.join(map(repr, sorted(lacking)))}, which these kernels do not evaluate",
            value=", ".join(sorted(lacking)),
            remedy="import the module that registers it, and install pisigma[compile]",
        )
    for feature, start in zip(wanted.features, correction.starts, strict=True):
        packed["correction"]["first"][0, forms.features.index(feature)] = start
    for form in wanted.closed_forms:
        packed["closed_form"]["kind"] = 1 + forms.closed_forms.index(form)
    network = description.network
    if network.samples > SAMPLES:
        raise ModelError(
            f"model '{name}': its domain has {network.samples} training rows, but the compiled kernels allow {SAMPLES}",
            expected=f"at most {SAMPLES} training rows",
            value=network.samples,
            remedy="use pisigma.load",
        )
    packed["network"]["inputs"] = len(network.source)
    packed["network"]["columns"] = len(network.column)
    packed["network"]["products"][0, : len(network.orders)] = (network.orders > 0).sum(-1)
    packed["coverage"]["stretches"] = len(description.coverage.joint)
    packed["starts"]["count"] = len(description.starts.q)
    return packed


def make_memory() -> np.ndarray:
    """Allocate working memory, `(1,)` of `MEMORY`."""
    return np.zeros(1, MEMORY)

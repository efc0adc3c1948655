"""One struct for an arm and one for working memory: kernels get a pointer each, whatever the robot.

Arrays are as long as the largest robot needs, with counts beside them, so that one compiled function serves all.
"""

from typing import Any

import numpy as np

from pisigma.errors import ModelError
from pisigma.kernels.arrays import PARTS, Description
from pisigma.kernels.forms import MOST_JOINTS, MOST_KINDS, MOST_VALUES, KernelForms

DOF = MOST_JOINTS
ROWS, FACTORS, UNITS, STRETCHES, STARTS = 24, 24, 12, 96, 512
"""The largest numbers of rows, factors and product units, stretches and starts."""
BRANCHES = 8
"""The largest number of branches of a closed form."""
INPUTS = 2 * DOF
"""The largest number of inputs of product units."""
GROUPS, SEEN, GROUP_INPUTS, SAMPLES, ENTRIES = 8, 512, 80, 2048, 2048 * 320
"""The largest numbers of groups of a network, inputs of all and of one, rows of a domain, and entries of these."""

LANES = 16
"""Poses whose forward kinematics is computed abreast."""

_Field = tuple[str, Any, tuple[int, ...]]


def _floats(**shapes: tuple[int, ...]) -> list[_Field]:
    return [(name, np.float64, shape) for name, shape in shapes.items()]


def _integers(**shapes: tuple[int, ...]) -> list[_Field]:
    return [(name, np.int64, shape) for name, shape in shapes.items()]


_ARMS = _integers(dof=(), rows_used=(), corrected=(), kind=(ROWS,), revolute=(DOF,)) + _floats(
    rows=(3, ROWS, 9), ends=(3, 2, 3, 4), reach=(3,), direction=(DOF,), limits=(DOF, 2)
)
_CORRECTION = _integers(
    inputs=(), products=(), frames=(), periodic=(), orders=(UNITS,), first=(MOST_KINDS,)
) + _floats(
    rate=(DOF,),
    middle=(DOF,),
    half=(DOF,),
    values=(MOST_VALUES,),
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
"""What kernels know of an arm: the fields of `compiled.arrays`, and counts."""

MEMORY = np.dtype(
    _floats(
        pose=(4, 4),  # the wanted pose
        near=(DOF,),  # joint values to stay near to
        approach=(DOF,),  # from which side every joint comes: +1 or -1, 0 where that is not stated
        rounding=(),  # relative size of what counts as rounding of the wanted poses
        solution=(DOF,),  # joint values found
        nominal=(DOF,),  # those of the nominal arm
        axes=(DOF, 6),  # of the joints: direction and origin
        T=(3, 4),  # pose and Jacobian of an arm
        J=(6, DOF),
        R=(3, 3),
        error=(6,),  # of the pose at a trial
        best=(6,),  # of the pose at the best so far, and the Jacobian there
        J_best=(6, DOF),
        trial=(DOF,),
        theta=(DOF,),  # joint values with correction
        delta=(DOF,),  # the correction, and the slope of its series
        slope=(DOF,),
        step=(DOF,),
        turning=(2, DOF),  # sines and cosines
        phi=(INPUTS,),  # inputs of product units
        frames=(DOF, 18),  # on which gravity acts
        scaled=(6, DOF),  # dimensionless Jacobian, normal equations and their right side
        square=(6, 6),
        right=(6,),
        branches=(BRANCHES, DOF),  # closed-form joint values of all branches
        others=(BRANCHES, DOF),  # the same of other poses, or as near to the pose as branches come
        wanted=(4, 4),  # a pose in the frames of the closed form
        q=(DOF,),  # joint values of a candidate
        start=(DOF,),  # joint values to start from
        kept=(DOF,),  # joint values outside their limits, in case there are no others
        checked=(DOF,),  # joint values that T, J and error belong to, NaN where they belong to none
        lanes=(12, LANES),  # frames of many poses, entry by entry
        lane_turns=(2, LANES),  # cosines and sines of a joint
        lane_axes=(DOF, 6, LANES),  # directions and origins of the joints
        seen=(SEEN,),  # scaled inputs of a network
        angles=(3,),  # roll, pitch and yaw
        distance=(SAMPLES,),  # squared, of scaled inputs from rows of a domain, or of poses from stored ones
    )
    + _integers(nearest=(128,))  # stored starts
)
"""What kernels work in: overwritten all the time, and nothing in it outlives a pose."""


def pack(description: Description, name: str, forms: KernelForms) -> np.ndarray:
    """A description as one struct, `(1,)` of `DESCRIPTION`.

    Args:
        description: the arm as arrays.
        name: of the model, for complaints.
        forms: what the kernels evaluate.

    Raises:
        ModelError: the arm is larger than the compiled kernels allow, or needs what they do not evaluate.
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
                    f"model '{name}': {part}.{field} has the shape {value.shape}, but the compiled kernels have room "
                    f"for {np.shape(room)}; use pisigma.load."
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
            f"model '{name}': it uses {', '.join(map(repr, sorted(lacking)))}, which these kernels do not evaluate; "
            "import what registers it, and install pisigma[compile]."
        )
    for feature, start in zip(wanted.features, correction.starts, strict=True):
        packed["correction"]["first"][0, forms.features.index(feature)] = start
    for form in wanted.closed_forms:
        packed["closed_form"]["kind"] = 1 + forms.closed_forms.index(form)
    network = description.network
    if network.samples > SAMPLES:
        raise ModelError(
            f"model '{name}': its domain has {network.samples} training rows, but the compiled kernels have room for "
            f"{SAMPLES}; use pisigma.load."
        )
    packed["network"]["inputs"] = len(network.source)
    packed["network"]["columns"] = len(network.column)
    packed["network"]["products"][0, : len(network.orders)] = (network.orders > 0).sum(-1)
    packed["coverage"]["stretches"] = len(description.coverage.joint)
    packed["starts"]["count"] = len(description.starts.q)
    return packed


def make_memory() -> np.ndarray:
    """Fresh memory to work in, `(1,)` of `MEMORY`."""
    return np.zeros(1, MEMORY)

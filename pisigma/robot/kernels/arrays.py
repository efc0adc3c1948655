"""Description of a calibrated arm for the compiled kernels, as plain arrays."""

from typing import Any, NamedTuple

from pisigma.robot.kernels.forms import KernelForms
from pisigma.robot.kinematics.status import Status

NOMINAL, IDENTIFIED, NOMINAL_WITHOUT_BASE = 0, 1, 2
"""Indices of the arms: the nominal arm, the arm with the identified geometry (for a hybrid, the geometry that
belongs to its correction), and the nominal arm without base, for gravity torques."""
CORRECTED = 3
"""Index of the identified arm with joint correction, at `q + Δ(q)`."""

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
"""Types of DH rows."""

NO_CLOSED_FORM = 0
"""Kind of a nominal arm without a closed form; other kinds are 1 + the index of the name in
`KernelForms.closed_forms`."""

REACHED = int(Status.REACHED)
SINGULAR = int(Status.SINGULAR)
OUTSIDE_LIMITS = int(Status.OUTSIDE_JOINT_LIMITS)
OUTSIDE_DOMAIN = int(Status.OUTSIDE_DOMAIN)
UNREACHABLE = int(Status.UNREACHABLE)
INVALID = int(Status.INVALID_POSE)

FINE, NOT_FINITE, LAST_ROW, NOT_ORTHONORMAL, LEFT_HANDED, NEAR_NOT_FINITE = -1, 1, 2, 3, 4, 5
"""Results of the check of a pose matrix and of the reference joint values."""

ANY_BRANCH, EVERY_BRANCH = -1, -2
"""Values that request any branch or all branches instead of the index of one branch."""
NEAREST = -2
"""Value that requests all branches of a closed form, with the nearest joint values of branches that do not reach the
pose."""

SOLVE, EVALUATE, FORWARD = 0, 1, 2
"""Tasks of the kernels: solve poses, evaluate the corrected arm, or compute poses and Jacobians of an arm."""

ANGLE, SINE, COSINE = 6, 7, 8
"""Kinds of network inputs; 0 to 5 are coordinates of the pose, in the order of `network.inputs.POSE_INPUTS`."""


class Arms(NamedTuple):
    """The rows of the three arms, which have the same joints.

    Attributes:
        kind: FIXED, REVOLUTE or PRISMATIC for every row.
        rows: `(3, rows, 9)`: theta [rad], d, a [m], cosine and sine of alpha, of beta and of theta.
        ends: `(3, 2, 3, 4)`: transforms of base and tool without their last rows.
        reach: reach of every arm [m].
        direction: +1 or -1 for every joint, the sign of the controller's values.
        revolute: 1 for every revolute joint, else 0.
        limits: `(dof, 2)`: joint limits [rad or m].
        corrected: 1 if the identified arm has a correction, else 0.
    """

    kind: Any
    rows: Any
    ends: Any
    reach: Any
    direction: Any
    revolute: Any
    limits: Any
    corrected: int


class Correction(NamedTuple):
    """The joint correction Δ(q); see `pisigma.joint_correction.joint_correction.JointCorrection`.

    Attributes:
        rate: angle of periodic functions per joint value, for every joint.
        middle: middle of every joint's travel [rad or m].
        half: half of every joint's travel [rad or m].
        values: concatenated numbers of all features, as returned by the features' method `pack`.
        starts: index of the first number of every feature, in the order of `Description.forms`.
        weight: `(factors, inputs, dof)`: weights of the product units.
        bias: `(factors, dof)`: biases of the product units.
        orders: number of factors of every product unit.
        periodic: 1 if the correction does not change when a joint turns by 360 deg, else 0.
        frames: 1 if a feature reads the frames of the joints, else 0.
    """

    rate: Any
    middle: Any
    half: Any
    values: Any
    starts: Any
    weight: Any
    bias: Any
    orders: Any
    periodic: int
    frames: int


class Coverage(NamedTuple):
    """Measured joint values; see `pisigma.calibration.hybrid.arm.JointCoverage`.

    Attributes:
        joint: joint of every measured interval.
        middle: middle of every interval [rad].
        half: half the length of every interval [rad].
        rate: angle per joint value, for every joint.
    """

    joint: Any
    middle: Any
    half: Any
    rate: Any


class Network(NamedTuple):
    """A network that corrects nominal joint values; see `network.correction_network` and `model.domain`.

    Attributes:
        used: 1 if there is a network, otherwise 0.
        source: kind of every input: a coordinate of the pose, ANGLE, SINE or COSINE; inputs of a group are consecutive.
        factors: `(inputs, dof)`: the angle of an input is the sum of the joint values times these factors.
        offset: offset of every input.
        scale: scale of every input.
        reference: `(groups, 3, 3)`: rotation to which roll, pitch and yaw are relative.
        first: `(groups + 1,)`: index of a group's first input.
        orders: `(groups, units)`: number of factors of every product unit, 0 if there is none.
        group: group of every joint; -1 if it is not corrected.
        weight: `(dof, factors, inputs)`: weights.
        bias: `(dof, factors)`: biases.
        output_offset: output offset of every joint [rad or m].
        output_scale: output scale of every joint [rad or m].
        centre: middle of every joint's values in the training rows [rad or m]; joint values are shifted to turns
            near it.
        samples: number of training rows of the domain; 0 without a domain.
        column: index of the input of every coordinate of the domain; identical inputs are one coordinate.
        times: square root of the number of occurrences of every coordinate's input in the network.
        coarse: number of leading coordinates that determine most of a distance.
        rows: `(coordinates · samples,)`: scaled inputs of the training rows, coordinate by coordinate.
        radius: radius of the domain, in scaled inputs.
    """

    used: int
    source: Any
    factors: Any
    offset: Any
    scale: Any
    reference: Any
    first: Any
    orders: Any
    group: Any
    weight: Any
    bias: Any
    output_offset: Any
    output_scale: Any
    centre: Any
    samples: int
    column: Any
    times: Any
    coarse: int
    rows: Any
    radius: float


class ClosedForm(NamedTuple):
    """The nominal arm with canonical twists; see `pisigma.robot.kinematics.closed_form`.

    Attributes:
        branches: number of branches; 1 without a closed form.
        order: indices of the branches in the order in which they are tried if none is requested.
        trained: number of leading branches in this order that have training rows.
        first: `(3, 4)`: base frame in the frame before the first joint.
        last: `(3, 4)`: frame of the last joint in that of the tool.
        sign: sign for every joint: `variable = sign · (direction · q + offset)`.
        direction: direction of every joint.
        offset: offset of every joint [rad or m].
        theta: sign · theta of every joint's row [rad].
        d: sign · d of every joint's row [m].
        a: a of every joint's row [m].
    """

    branches: int
    order: Any
    trained: int
    first: Any
    last: Any
    sign: Any
    direction: Any
    offset: Any
    theta: Any
    d: Any
    a: Any


class Starts(NamedTuple):
    """Stored joint values from which the iteration may start.

    Attributes:
        q: `(starts, dof)`: joint values [rad or m].
        points: `(starts, 12)`: positions [m], and rotations times half a reach over sqrt(2).
        lever: half a reach over sqrt(2) [m].
    """

    q: Any
    points: Any
    lever: float


class Description(NamedTuple):
    """Complete description of a calibrated arm.

    Attributes:
        forms: names of the features of its correction and of its closed form, if any.
    """

    arms: Arms
    correction: Correction
    coverage: Coverage
    network: Network
    closed_form: ClosedForm
    starts: Starts
    forms: KernelForms = KernelForms()


PARTS: dict[str, Any] = {part: kind for part, kind in Description.__annotations__.items() if part != "forms"}
"""Classes of the parts of a description, by name."""

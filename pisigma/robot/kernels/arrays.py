"""What the compiled kernels know of a calibrated arm, as plain arrays."""

from typing import Any, NamedTuple

from pisigma.robot.kernels.forms import KernelForms
from pisigma.robot.kinematics.status import Status

NOMINAL, IDENTIFIED, DRAWN = 0, 1, 2
"""Which arm: as modelled, with the identified geometry (of a hybrid the one that goes with its correction), and as
drawn without base, on which gravity acts."""
CORRECTED = 3
"""The identified arm at `q + Δ(q)`."""

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
"""What moves in a row."""

NO_CLOSED_FORM = 0
"""Of a nominal arm that has none; else the kind is 1 + the index of its name in `KernelForms.closed_forms`."""

REACHED = int(Status.REACHED)
SINGULAR = int(Status.SINGULAR)
OUTSIDE_LIMITS = int(Status.OUTSIDE_JOINT_LIMITS)
OUTSIDE_DOMAIN = int(Status.OUTSIDE_DOMAIN)
UNREACHABLE = int(Status.UNREACHABLE)
INVALID = int(Status.INVALID_POSE)

FINE, NOT_FINITE, LAST_ROW, NOT_ORTHONORMAL, LEFT_HANDED, NEAR_NOT_FINITE = -1, 1, 2, 3, 4, 5
"""What is wrong with a matrix that should be a pose, or with the joint values to be near to."""

ANY_BRANCH, EVERY_BRANCH = -1, -2
"""Instead of the index of a branch."""
NEAREST = -2
"""The same for closed forms: all branches, as near to the pose as they come where they do not reach it."""

SOLVE, EVALUATE, FORWARD = 0, 1, 2
"""What the kernels are to do: solve poses, evaluate the corrected arm, or only where an arm stands and how it moves."""

ANGLE, SINE, COSINE = 6, 7, 8
"""What an input of a network is; 0 to 5 are coordinates of the pose, in the order of `network.inputs.POSE_INPUTS`."""


class Arms(NamedTuple):
    """The rows of the three arms, which have the same joints.

    Attributes:
        kind: per row FIXED, REVOLUTE or PRISMATIC.
        rows: `(3, rows, 9)`: theta [rad], d, a [m], cosine and sine of alpha, of beta and of theta.
        ends: `(3, 2, 3, 4)`: transforms of base and tool without their last rows.
        reach: of every arm [m].
        direction: per joint +1 or -1, how the controller counts.
        revolute: per joint 1 where it turns, else 0.
        limits: `(dof, 2)` [rad or m].
        corrected: 1 where a correction goes with the identified arm, else 0.
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
        rate: per joint, angle per joint value.
        middle: of every joint's values [rad or m].
        half: of every joint's travel [rad or m].
        values: the numbers of all features one after the other, as their `pack` gives them.
        starts: where those of every feature begin, in the order of `Description.forms`.
        weight: `(factors, inputs, dof)` of the product units.
        bias: `(factors, dof)` of the product units.
        orders: number of factors of every product unit.
        periodic: 1 where the correction is the same on all turns, else 0.
        frames: 1 where a feature reads the frames of the joints, else 0.
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
        joint: of every stretch.
        middle: of every stretch [rad].
        half: half its length [rad].
        rate: per joint, angle per joint value.
    """

    joint: Any
    middle: Any
    half: Any
    rate: Any


class Network(NamedTuple):
    """What corrects nominal joint values; see `network.correction_network` and `correction.domain`.

    Attributes:
        used: 1 where there is such a network, else 0.
        source: per input its kind: a coordinate of the pose, ANGLE, SINE or COSINE. Those of a group lie together.
        factors: `(inputs, dof)`: the angle of an input is their sum over the joint values.
        offset: of every input.
        scale: of every input.
        reference: `(groups, 3, 3)`: rotation from which roll, pitch and yaw are counted.
        first: `(groups + 1,)`: index of a group's first input.
        orders: `(groups, units)`: number of factors of every product unit, 0 where there is none.
        group: per joint; -1 where the joint is not corrected.
        weight: `(dof, factors, inputs)`.
        bias: `(dof, factors)`.
        output_offset: per joint [rad or m].
        output_scale: per joint [rad or m].
        centre: per joint the middle of training rows [rad or m], on whose turns the network knows joint values.
        samples: number of training rows that make the domain; 0 where there is none.
        column: index of the input that a coordinate of the domain is; inputs that are the same are one coordinate.
        times: per coordinate the root of how often its input stands in the network.
        coarse: how many coordinates, the first ones, tell nearly all of a distance.
        rows: `(coordinates · samples,)`: scaled inputs of the training rows, one coordinate after the other.
        radius: of the domain, in scaled inputs.
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
        branches: how many it has; 1 without closed form.
        order: indices of the branches in the order in which they are tried where none is asked for.
        trained: how many of these, the first ones, training rows lie on.
        first: `(3, 4)`: frame of poses in the frame before the first joint.
        last: `(3, 4)`: frame of the last joint in that of the tool.
        sign: per joint, `variable = sign · (direction · q + offset)`.
        direction: per joint.
        offset: per joint.
        theta: of every joint's row, with sign [rad].
        d: of every joint's row, with sign [m].
        a: of every joint's row [m].
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
    """Joint values to start from.

    Attributes:
        q: `(starts, dof)` [rad or m].
        points: `(starts, 12)`: positions [m], and rotations times half a reach over sqrt(2).
        lever: half a reach over sqrt(2) [m].
    """

    q: Any
    points: Any
    lever: float


class Description(NamedTuple):
    """All of a calibrated arm.

    Attributes:
        forms: names of the features that its correction has, and of its closed form, if it has one.
    """

    arms: Arms
    correction: Correction
    coverage: Coverage
    network: Network
    closed_form: ClosedForm
    starts: Starts
    forms: KernelForms = KernelForms()


PARTS: dict[str, Any] = {part: kind for part, kind in Description.__annotations__.items() if part != "forms"}
"""The parts of a description by name."""

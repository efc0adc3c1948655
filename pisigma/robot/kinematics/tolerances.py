"""Tolerances and iteration limits of inverse kinematics, shared by kernels and torch, without importing torch."""

POSE_TOLERANCE, POSE_TOLERANCE_SINGLE = 1e-6, 1e-4
"""Largest deviation of `R^T R` from the identity and of the last row from (0, 0, 0, 1), for float64 and float32."""

MEASURED_ROUNDING = 1e-9
"""Largest excess [rad] over the measured joint range that is treated as measured, because commanded values of measured
poses equal those of the rows only up to the residuals of their solution."""

LIMIT_TOLERANCE = 1e-9
"""Largest excess [rad or m] over a joint limit that is treated as within the limits; the value is not changed."""

SINGULAR_TOLERANCE = 1e-5
"""`singularity_measure` below which a solution is SINGULAR (in float32: 3e-3). The iteration only gets within about
1e-6 rad of a singular solution, because residuals there grow with the square of the joint error."""

ROUNDING_UNITS = 500
"""Multiples of the float type's epsilon up to which a cosine beyond 1 is treated as 1 and a length as 0 (1.1e-13 in
float64)."""

TILT_TOLERANCE = 1e-9
"""Largest tilt [rad] of the target tool axis from the joint axes of a SCARA that is treated as rounding."""

TRIANGLE_MARGIN = 1e-9
"""Relative distance of two links from being stretched or folded if a free joint moves so that they reach a point."""

TOLERANCE, HYBRID_TOLERANCE = 1e-13, 1e-12
"""Residuals [m and rad] at which the iteration of an arm has converged, without a joint correction and with one,
which adds rounding errors."""

ACCEPTED = 1e-11
"""Residuals [m and rad] that are accepted if rounding stops the iteration earlier."""

INITIAL_DAMPING, MIN_DAMPING, MAX_DAMPING = 0.1, 1e-6, 1e12
"""Factor of the squared error in the damping: initial value, smallest value, and value at which an iteration is
abandoned."""

DAMPING_DOWN, DAMPING_UP = 0.2, 8.0
"""Change of the damping factor after a step that decreases the error, and after one that does not."""

STALL_RATIO, MAX_STALLED = 0.95, 5
"""Ratio of squared errors above which a step has stalled, and number of consecutive stalled steps after which an
iteration is abandoned."""

MAX_ITERATIONS = 100
"""Largest number of damped steps of an iteration."""

NEAR_MISS = 0.01
"""Residual, as a share of the reach and as an angle [rad], below which an arm may reach a pose with its joint
correction."""

REACH_ROUNDING = 1e-9
"""Relative excess of a pose's distance over the reach that is treated as rounding."""

NEAREST_MARGIN = 2e-4
"""Distance of the cosine from 1 (1.1 deg) that stretched or folded branches keep when they start an iteration."""

BRANCH_MISS = 0.05
"""Residual, as a share of the reach and as an angle [rad], of a branch of the nominal arm from which the calibrated arm
may still reach a pose; its parameter errors are far smaller."""

ATTEMPTS, MORE_ATTEMPTS = 4, 128
"""Numbers of stored starts that are tried for a pose, nearest first, for closed-form and numeric inverse kinematics."""

FAR_AWAY = 0.1
"""Distance [rad or m] from the reference joint values above which a solution may not be the intended one."""

MAX_CORRECTION = 1.0
"""Upper bound on joint corrections [rad or m], with which the nearest branch is found without correcting branches that
are farther away."""

FORWARD_ITERATIONS, FORWARD_TOLERANCE, FORWARD_ACCEPTED = 100, 1e-12, 1e-9
"""Largest number of fixed-point iterations from corrected to nominal joint values, change [rad or m] at which they have
converged, and change that is accepted after the last iteration."""

MAX_STEPS, MAX_STEP = 40, 0.3
"""Largest number and size [rad or m] of the steps of redundant joints towards their preferred values."""

STEP_TOLERANCE = 1e-9
"""Size of a step of redundant joints [rad or m] below which the iteration ends."""

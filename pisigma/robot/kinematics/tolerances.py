"""Tolerances and limits of iterations of inverse kinematics, the same for kernels and torch; known without torch."""

POSE_TOLERANCE, POSE_TOLERANCE_SINGLE = 1e-6, 1e-4
"""Largest deviation of `R^T R` from the identity and of the last row from (0, 0, 0, 1); of poses in float32."""

MEASURED_ROUNDING = 1e-9
"""How far [rad] a joint may lie beyond its measured values and still count as measured: commanded values of measured
poses are those of the rows up to the residuals of their solution."""

LIMIT_TOLERANCE = 1e-9
"""How far [rad or m] a value may lie beyond a limit and still count as on it; it is not moved."""

SINGULAR_TOLERANCE = 1e-5
"""A solution is SINGULAR where `singularity_measure` is smaller (in float32: than 3e-3). Iteration comes
within some 1e-6 rad of a singular solution, as residuals there grow with the square of the joint error."""

ROUNDINGS = 500
"""A cosine beyond 1 or a length by fewer roundings of its float type counts as 1 or 0 (1.1e-13 in float64)."""

TILT_TOLERANCE = 1e-9
"""Largest tilt [rad] of the wanted tool axis from the joint axes of a SCARA that is taken for rounding."""

TRIANGLE_MARGIN = 1e-9
"""Relative distance that the two links of an arm keep from stretched and folded where a free joint turns for them."""

TOLERANCE, HYBRID_TOLERANCE = 1e-13, 1e-12
"""[m and rad] Residuals that the iteration of an arm comes below; a joint correction costs a few more roundings."""

ACCEPTED = 1e-11
"""[m and rad] Residuals that will do where rounding stops the iteration earlier."""

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 0.1, 1e-6, 1e12
"""Factor of the squared error in the damping: at first, at least, and where an iteration is given up."""

DAMPING_DOWN, DAMPING_UP = 0.2, 8.0
"""What the factor is multiplied by after a step that brings the tool nearer, and after one that does not."""

STALLED, MOST_STALLED = 0.95, 5
"""Share of the squared error that a step leaves which leads nowhere, and after how many in a row to give up."""

ITERATIONS = 100
"""Damped steps after which an iteration is given up."""

NEARLY = 0.01
"""Share of the reach, and angle [rad]: a pose that an arm misses by less it may take with its joint correction."""

REACH_ROUNDING = 1e-9
"""Share of the reach by which a pose may lie farther away than the robot is long."""

NEAREST_MARGIN = 2e-4
"""Cosine of how far stretched or folded branches stay from that, 1.1 deg, where they are starts of an iteration."""

BESIDE = 0.05
"""Share of the reach, and angle [rad], by which a branch of the nominal arm may miss a pose that the calibrated one can
reach from there, whose errors are far smaller."""

ATTEMPTS, MORE_ATTEMPTS = 4, 128
"""Stored starts that are tried for a pose, nearest first; the latter on arms without closed form."""

AWAY = 0.1
"""[rad or m] A solution farther from where it was to be near to may not be the one that was meant."""

LARGEST_CORRECTION = 1.0
"""[rad or m] Corrections are smaller, so that branches that are farther off need not be corrected to be compared."""

FORWARD_ITERATIONS, FORWARD_TOLERANCE, FORWARD_ACCEPTED = 100, 1e-12, 1e-9
"""Rounds after which nominal joint values of corrected ones are given up; change [rad or m] in a round at which they
have settled, and at which they will do after the last round."""

ROUNDS, STRIDE = 40, 0.3
"""The largest number and size [rad or m] of steps by which joints to spare come to where they are preferred."""

STILL = 1e-9
"""[rad or m] Such a step that is shorter is the last one."""

"""Rows of the modified convention (Craig 1986, section 3.4) as rows of the standard one."""

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import RobotError
from pisigma.robot.urdf_frames import frame_of, shift, turn, xyzrpy_of


def from_modified(
    dh: Float64[np.ndarray, "rows 5"], base: Float64[np.ndarray, " 6"]
) -> tuple[Float64[np.ndarray, "rows 5"], Float64[np.ndarray, " 6"]]:
    """Regroup `Π RotX(alpha) · Trans(a, 0, 0) · RotZ(theta) · Trans(0, 0, d)` into standard rows, exactly.

    What leads to a joint in the modified convention belongs to the row before in the standard one; alpha and a of the
    first row go into the base.

    Args:
        dh: theta [rad], d, a [m], alpha, beta [rad] of modified rows.
        base: x, y, z [m], roll, pitch, yaw [rad].

    Returns:
        Standard rows and the base that goes with them; the tool stays.

    Raises:
        RobotError: a row has a beta, which the modified convention does not know.
    """
    if dh[:, 4].any():
        raise RobotError(
            f"row {int(dh[:, 4].nonzero()[0][0]) + 1}: the modified convention has no beta_deg; leave it out or use "
            "the standard convention."
        )
    standard = dh.copy()
    standard[:, 2:4] = np.roll(dh[:, 2:4], -1, axis=0)
    standard[-1, 2:4] = 0.0
    if dh[0, 2:4].any():
        base = xyzrpy_of(frame_of(base) @ turn(0, dh[0, 3]) @ shift(dh[0, 2], 0.0, 0.0))
    return standard, base

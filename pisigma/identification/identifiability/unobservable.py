"""What a set-up cannot tell whatever its poses are: the scale, or where a frame stands."""

import torch

from pisigma.identification.problem.setup import CalibrationSetup

SAME_FACE = 1e-6
"""[m] Coordinates within this are of one face."""
TOUCHES_WITHOUT_SCALE = (
    "the touches of every frame and axis are at one coordinate, which a robot of any size can meet, so the scale stays "
    "as drawn; touch faces at different coordinates along an axis."
)
SOCKETS_WITHOUT_SCALE = (
    "sockets alone are met by a robot of any size, so the scale stays as drawn; give the distance between two sockets "
    "(socket_distances), or measure one length otherwise."
)


def untold(setup: CalibrationSetup) -> tuple[str, ...]:
    """Say what the set-up cannot tell, and what to measure for it."""
    return (*_scale(setup), *_frames(setup), *_adrift(setup))


def _scale(setup: CalibrationSetup) -> list[str]:
    if tells_scale(setup):
        return []
    touched = "touch" in setup.measurements.kinds
    return [TOUCHES_WITHOUT_SCALE if touched else SOCKETS_WITHOUT_SCALE]


def tells_scale(setup: CalibrationSetup) -> bool:
    """Whether any length was measured.

    Sockets are met by a robot of any size; touches give lengths by faces at different coordinates. Orientations
    alone have none, but do not pretend to.
    """
    data = setup.measurements
    if data.touch is None and data.socket is None:
        return True
    certain = any(sensor.certain for sensor in setup.problem.sensors)
    if certain or not data.kinds & {"touch", "socket"} or data.kinds & {"pose", "position", "distance"}:
        return True
    faces: dict[tuple[str, str], list[float]] = {}
    if data.touch is not None and data.touch_axis is not None:
        for frame, axis, value in zip(data.frame, data.touch_axis, data.touch.tolist(), strict=True):
            if axis:
                faces.setdefault((frame, axis), []).append(value)
    return any(max(values) - min(values) > SAME_FACE for values in faces.values())


def _frames(setup: CalibrationSetup) -> list[str]:
    """Frames that are touched along some axes only."""
    data = setup.measurements
    if data.touch is None or data.touch_axis is None or not setup.problem.space.of("base"):
        return []
    other = (data.measured("position") | data.measured("pose")).tolist()
    found = []
    for frame in setup.problem.space.frames:
        rows = [row for row, name in enumerate(data.frame) if name == frame]
        axes = {data.touch_axis[row] for row in rows if data.touch_axis[row]}
        lacking = [axis for axis in "xyz" if axis not in axes]
        if axes and lacking and not any(other[row] for row in rows):
            found.append(
                f"frame '{frame}' was touched along {' and '.join(sorted(axes))} only, so where it stands along "
                f"{' and '.join(lacking)} is not told; touch faces that are square to "
                f"{'it' if len(lacking) == 1 else 'them'} too."
            )
    return found


def frames_adrift(setup: CalibrationSetup) -> list[str]:
    """Frames in which nothing that was measured stands at a known place: whatever is there may move as a whole."""
    data = setup.measurements
    if data.socket is None and data.distance is None:
        return []
    held = (
        data.measured("position") | data.measured("pose") | data.measured("touch") | data.measured("rotation")
    )
    if data.anchor_place is not None:
        held |= torch.isfinite(data.anchor_place).all(-1)
    known = {frame for frame, told in zip(data.frame, held.tolist(), strict=True) if told}
    if not data.kinds & {"socket", "distance"}:
        return []
    return [frame for frame in setup.problem.space.frames if frame not in known]


def _adrift(setup: CalibrationSetup) -> list[str]:
    adrift = frames_adrift(setup)
    if not adrift:
        return []
    names = " and ".join(f"'{frame}'" for frame in adrift)
    where = f"frame{'s' if len(adrift) > 1 else ''} {names}" if any(adrift) else "the frame"
    return [
        f"nothing that was measured in {where} stands at a known place, so where the robot's base is there is not "
        "told: predicted positions are right among each other, up to one motion of them all; measure three "
        "positions, touches, or distances from anchors at known places for that."
    ]

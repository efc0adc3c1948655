"""A Franka FR3 whose ball sits in the three sockets of each of three plates."""

from shared_benchmark.public_series import Series

SERIES = Series(
    name="fr3",
    title="Franka FR3, sockets",
    citation="Holiday-Robot, github.com/Holiday-Robot/kinematics_calibration",
    url="https://github.com/Holiday-Robot/kinematics_calibration/tree/779b8003",
    licence="MIT",
    sensor="ball in sockets about 40 mm apart",
    file="holiday/fr3_sockets.csv",
    sha256="0236eb301dd75576a91aff5ddaa117aeee99de68003cd6a68c71ecbca8aba4e5",
    robot="fr3",
    urdf="holiday/fr3.urdf",
    tip="ball_link",
    splits={
        "placements": "0dbecc9861612cefc60be0c8448422b7883d605403e59842c2392d65e4299754",
    },
    distances={
        ("A/0", "A/1"): 0.03990,
        ("A/1", "A/2"): 0.03992,
        ("B/0", "B/1"): 0.03997,
        ("B/1", "B/2"): 0.04000,
        ("C/0", "C/1"): 0.03993,
        ("C/1", "C/2"): 0.03996,
    },
)

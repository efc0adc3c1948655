"""A Franka Panda whose ball sits in pairs of sockets at six placements."""

from shared_benchmark.public_series import Series

SERIES = Series(
    name="panda",
    title="Franka Panda, sockets",
    citation="platonics-delft 2024, github.com/platonics-delft/kinematics_calibration",
    url="https://github.com/platonics-delft/kinematics_calibration/tree/05a05ab4",
    licence="MIT",
    sensor="ball in sockets 50 mm apart",
    file="panda_sockets/panda_3.csv",
    sha256="36ede8c2f96c0bcbc4214159d42c03248e4e396d78d80fe663a58f90cb871178",
    robot="panda",
    splits={
        "placements": "e91940740f22a52fdfce1970098eb1fc90065e68de8fe3c875d8cf0350aeef0f",
    },
    distances={("*/0", "*/1"): 0.05},
)

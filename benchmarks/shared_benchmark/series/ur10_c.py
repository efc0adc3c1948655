"""A UR10 at random poses, measured with a 6D target."""

from shared_benchmark.public_series import Series

SERIES = Series(
    name="ur10_c",
    title="UR10, series C",
    citation="C. Landgraf 2021, github.com/christianlandgraf/ipa-robot-accuracy",
    url="https://github.com/christianlandgraf/ipa-robot-accuracy/tree/507fba69",
    licence="MIT",
    sensor="laser tracker with T-Mac, poses; temperature",
    file="ur10/series_c_train.csv",
    sha256="6aa705640d02c2512e728f2a1146d64be36d7138b21100b2572a059106f4643f",
    robot="ur10",
    splits={
        "random": "90260a4fb882b5acd22bcc763bc209535e43b6a192f3ad235622e23083a9a939",
        "space": "bfb2e145116f91a47923988d5cb585fdb33c31209502340b20461e5a889b4ee8",
        "box": "15fe8044e6e1a1c5c317e95817421c0259526632f26ebfa98f2b38499aee1ff7",
        "session": "f5a647b14ea4a50120a3b563c4beef4978256ae9cd40f59ae3edc30a8f8ea5db",
        "rows_30": "8026f645bb90c4526a215ea0cd70ed5e79bb577c6d4d1f513910c20b938d5853",
        "rows_100": "b0c5fac02c24c31cd67a1b7cfe2dae20d5e90c4db430ec90d15d4932994d869d",
        "rows_300": "0224560cd4dff74cd8ddc3d30d4adb08511c8c94d48e077b28f4d3a1b44bd75e",
    },
    other_session="ur10_b",
    note="1941 rows, our own random 70 % of the published series; the other rows are kept for judging.",
)

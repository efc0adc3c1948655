"""The UR10 of series C in another month, at configurations of a grid in joint space."""

from shared_benchmark.public_series import Series

SERIES = Series(
    name="ur10_b",
    title="UR10, series B",
    citation="C. Landgraf 2021, github.com/christianlandgraf/ipa-robot-accuracy",
    url="https://github.com/christianlandgraf/ipa-robot-accuracy/tree/507fba69",
    licence="MIT",
    sensor="laser tracker with T-Mac, poses; temperature",
    file="ur10/series_b.csv",
    sha256="58517d52cfb40a595bf18339a7f9134dedbc77f4fa51925d1d715d91c4267cdd",
    robot="ur10",
    splits={
        "random": "ccb4672793813c8d89057e842e33f5393e3c338c8a698cf9c0dc2349779dfb77",
        "space": "c7855f554da13b988a932d5c8b46cda23f393a03b4db8a5cf2760c215cd0b232",
        "session": "3e739009e4bee4e53ae79f1cbcf89a60102b5982fa827a79aa0f5fecd202337a",
        "rows_30": "84b99ba1e9218c4f3382504ada0bf94bf8f0d41c7629bdacf1f808e34b4ed14d",
        "rows_100": "fabd14e9cd616cd2abcc663aeaa483f951155fec59e4d4f209dc275e3f38c0f9",
        "rows_300": "9fea9f74d6caf93c1014fe78f03a5f583fa90d84ff6e0ad464852e836de1bbc6",
    },
    other_session="ur10_c",
    note="Rows 532, 854 and 855 are about 2 mm off for every method. They stay in all figures; without them, the error "
    "of `hybrid` on `random` is 0.079 mm instead of 0.123 mm. 293 rows repeat the pose of another row up to 0.22 mrad; "
    "repeats are in one fold.",
)

"""A FANUC R-2000iC/165F at 24 configurations with 10 repeats, measured with three reflectors."""

from shared_benchmark.public_series import Series

SERIES = Series(
    name="fanuc",
    title="FANUC R-2000iC/165F",
    citation="D. Burakov 2020, github.com/Sarrasor/RoboticManipulators",
    url="https://github.com/Sarrasor/RoboticManipulators/tree/4e05acfe",
    licence="MIT",
    sensor="laser tracker, positions of three reflectors",
    file="fanuc_r2000/positions.csv",
    sha256="299a64047461cd03cdd8e199854605d7a65f54879eaf09af6d7058c5ddf5b8c4",
    robot="fanuc_r2000",
    splits={
        "configurations": "692f96bca5c1353de44cf572df813272d8718dff8454082dad6ac02676a2e7aa",
        "random": "b77ebb215a995f1a2e7688690e0ea32c032f47a0126cad7780d1060be7d9c1c5",
    },
    note="24 configurations, 10 repeats, 3 reflectors; the repeats of a configuration stay together.",
)

"""A UR5 on grid-like poses, measured with one reflector."""

from shared_benchmark.public_series import Series

SERIES = Series(
    name="ur5_grid",
    title="UR5, grid",
    citation="P. Jacobi 2025, github.com/pauljac7700/serial_robots_datasets",
    url="https://github.com/pauljac7700/serial_robots_datasets/tree/759068d8",
    licence="MIT",
    sensor="laser tracker, positions of one reflector",
    file="ur5/grid.csv",
    sha256="2626fd97b8fb4ab164a0f87226dbd30f63ccca41f87007114028ddbc92787285",
    robot="ur5",
    splits={
        "random": "ee806c669490931c8afa994c3e618fa5cce869277b1929607fbb393c8e29bc99",
        "space": "9c1ac633902a8142820cc2932a5d80cc328c44cb2ad7b11b591c1c1f678f8b63",
        "box": "345f447cb3b6c5a206e23934fbc35b686fe280b27e94c1ff26b952f43b8f3cfc",
        "rows_30": "81b967f86d3de0121fa6d753f3d12d2022cbd28a1064bfe360bfb10232dde69c",
        "rows_100": "57711e526c65e188e65aada27ab8303dfc824c098507fd67f46e2fb237253a25",
        "rows_300": "1ca801fc24264ceaa4746479daa33e56210f1dc5ab0a4f5912bfdc106473b3a6",
    },
    note="Measured position = published target + published difference.",
)

"""``adcs run``: a scenario simulated, its attitude estimated and judged."""

from __future__ import annotations

from magloc.cli.framework import new_app
from sims.cli.run_tabletsat import run_attitude

_COMMANDS = (
    (
        "complementary",
        "sims.cli.run_complementary:complementary",
        "Attitude of a satellite from magnetometer, Sun sensor and gyro by complementary filters.",
    ),
    (
        "detumbling",
        "sims.cli.run_detumbling:detumbling",
        "Rate of a tumbling satellite taken out by torquers, with B-dot of its magnetometer, or by rods.",
    ),
    (
        "ellipsoid",
        "sims.cli.run_ellipsoid:ellipsoid",
        "Yaw of a satellite from a horizon sensor and gyros, in guaranteed ellipsoids.",
    ),
    (
        "mockup",
        "sims.cli.run_mockup:mockup",
        "Table-top satellite that looks up at a sky of LEDs: star identification, zeros, and fusion of late fixes.",
    ),
)
run = new_app(
    "run", "Simulate a scenario, estimate its attitude, and say how good that is.", _COMMANDS, version_flags=[]
)
run.default(run_attitude)

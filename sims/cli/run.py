"""``adcs run``: simulated scenarios and the errors of their estimates."""

from __future__ import annotations

from magloc.cli.framework import new_app
from sims.cli.run_tabletsat import run_attitude

_COMMANDS = (
    ("complementary", "sims.cli.run_complementary:complementary", "Run complementary filters of a satellite."),
    ("detumbling", "sims.cli.run_detumbling:detumbling", "Stop the tumbling of a satellite by torquers or rods."),
    ("ellipsoid", "sims.cli.run_ellipsoid:ellipsoid", "Estimate yaw in guaranteed ellipsoids."),
    ("mockup", "sims.cli.run_mockup:mockup", "Run the table-top satellite under a sky of LEDs."),
)
run = new_app("run", "Simulate a scenario, estimate its attitude, and report the errors.", _COMMANDS, version_flags=[])
run.default(run_attitude)

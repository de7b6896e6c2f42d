"""The command line ``adcs``.

Every command is a function in a module of :mod:`adcs.cli`; its NumPy docstring is its help text. What the command
lines have in common is in :mod:`magloc.cli.framework`.
"""

from __future__ import annotations

from collections.abc import Sequence

from magloc.cli import framework

COMMANDS = (
    ("run", "sims.cli.run:run", "Simulate a scenario, estimate its attitude, and say how good that is."),
    (
        "compare",
        "sims.cli.compare:compare",
        "Run several scenarios, sets of sensors or filters on the same seeds and show them side by side.",
    ),
    (
        "tables",
        "sims.cli.tables:tables",
        "Tables 3, 4 and 5 of Ivanov et al. (Keldysh Institute preprint 64, 2014): their value, ours, and the ratio.",
    ),
    (
        "estimate",
        "adcs.cli.estimate:estimate",
        "Estimate attitude and rate from telemetry, with the filters of `adcs run`.",
    ),
    ("calibrate", "adcs.cli.calibrate:calibrate", "Calibrate the magnetometer of a log by the field along the orbit."),
    (
        "loads",
        "adcs.cli.loads:loads",
        "Find the fields of what switches on board at each magnetometer, and where it is.",
    ),
    (
        "vectors",
        "adcs.cli.vectors:vectors",
        "Attitude of every row of telemetry from field and Sun alone, by TRIAD or QUEST.",
    ),
    (
        "imu",
        "adcs.cli.imu:imu",
        "Attitude of an inertial unit with a magnetometer, with iron and magnets near it or not.",
    ),
    ("demo", "adcs.cli.demo:demo", "Estimate the attitude of a simulated satellite, and draw what comes out."),
    (
        "stars",
        "adcs.cli.stars:stars",
        "Identify the stars of images by a catalogue, without knowing where the camera looked.",
    ),
    (
        "view",
        "adcs.cli.view:view",
        "See the attitude of a log in three dimensions, in a browser, as a page, a picture or a film.",
    ),
    (
        "warm-up",
        "magloc.cli.first_steps.warm_up:warm_up",
        "Do nothing: no command compiles anything any more. The next release removes it.",
    ),
)
app = framework.new_program("adcs", "Determine the attitude of satellites.", COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command."""
    return framework.run(app, arguments)

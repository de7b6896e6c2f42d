"""The command line ``adcs``.

Every command is a function in a module of :mod:`adcs.cli`; its NumPy docstring is its help text. The shared parts of
all command lines are in :mod:`magloc.cli.framework`.
"""

from __future__ import annotations

from collections.abc import Sequence

from magloc.cli import framework

COMMANDS = (
    ("run", "sims.cli.run:run", "Simulate a scenario, estimate its attitude, and report the errors."),
    ("compare", "sims.cli.compare:compare", "Compare scenarios, sets of sensors or filters on the same seeds."),
    ("tables", "sims.cli.tables:tables", "Repeat Tables 3 to 5 of Ivanov et al. (2014)."),
    ("estimate", "adcs.cli.estimate:estimate", "Estimate attitude and rate from telemetry."),
    ("calibrate", "adcs.cli.calibrate:calibrate", "Calibrate a magnetometer by the field along the orbit."),
    (
        "calibrate-log",
        "adcs.cli.calibrate_log:calibrate_log",
        "Calibrate the compass of a drone or robot from a flight or drive.",
    ),
    ("loads", "adcs.cli.loads:loads", "Find the fields and places of loads that switch on board."),
    ("vectors", "adcs.cli.vectors:vectors", "Compute the attitude of every row from field and Sun (TRIAD, QUEST)."),
    ("imu", "adcs.cli.imu:imu", "Estimate the attitude of an inertial unit with a magnetometer."),
    ("live", "adcs.cli.live:live", "Estimate the attitude of an inertial unit while readings arrive."),
    ("demo", "adcs.cli.demo:demo", "Simulate a satellite and estimate its attitude."),
    ("stars", "adcs.cli.stars:stars", "Identify the stars of images."),
    ("view", "adcs.cli.view:view", "Show the attitude of a log in three dimensions."),
    ("warm-up", "magloc.cli.first_steps.warm_up:warm_up", "Do nothing; the next release removes it."),
)
app = framework.new_program("adcs", "Determine the attitude of satellites.", COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command."""
    return framework.run(app, arguments)

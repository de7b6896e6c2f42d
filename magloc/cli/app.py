"""The command line ``magloc``.

Every command is a function in a module of :mod:`magloc.cli`; its NumPy docstring is its help text. It raises
:class:`arrays.io.errors.InputError` for bad input. The shared parts of all command lines are in
:mod:`magloc.cli.framework`.
"""

from __future__ import annotations

from collections.abc import Sequence

from magloc.cli import framework

COMMANDS = (
    ("calibrate", "magloc.cli.calibration.calibrate:calibrate", "Calibrate vector sensors."),
    ("locate", "magloc.cli.locate:locate", "Locate the sources in every row of a readings file."),
    ("map", "magloc.cli.map:map_", "Map from which starts a filter converges, or which sources a fix finds."),
    ("track", "magloc.cli.track:track", "Track a source, or several, through time."),
    ("live", "magloc.cli.live:live", "Track a source, or several, while readings arrive."),
    ("signature", "magloc.cli.moments.signature:signature", "Estimate the magnetic signature of a ship."),
    ("bounds", "magloc.cli.bounds:bounds", "Compute Cramér-Rao bounds, and how far an array reaches."),
    ("design", "magloc.cli.design:design", "Optimise the positions of an array's sensors."),
    ("new-array", "magloc.cli.first_steps.new_array:new_array", "Write an array file."),
    (
        "export-config",
        "magloc.cli.first_steps.export_config:export_config",
        "Write an array or satellite as a C++ header.",
    ),
    ("columns", "magloc.cli.first_steps.columns:columns", "Propose how to read the log of another program."),
    ("qc", "magloc.cli.surveys.qc:qc", "Check the quality of a field log."),
    ("survey", "magloc.cli.surveys.survey:survey", "Find targets at rest in the ground."),
    ("compensate", "magloc.cli.surveys.compensate:compensate", "Remove the field of a platform."),
    ("demo", "magloc.cli.first_steps.demo:demo", "Simulate, locate and track a magnet."),
    ("simulate", "sims.cli.simulate:simulate", "Simulate the readings of an array."),
    ("view", "magloc.cli.view:view", "Show an array, readings, a track or a map in three dimensions."),
    ("warm-up", "magloc.cli.first_steps.warm_up:warm_up", "Do nothing; the next release removes it."),
)
app = framework.new_program("magloc", "Find magnetic dipoles from the differences between magnetometers.", COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments : sequence of str, optional
        The command and its arguments; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 2 bad input, 130 interrupted, 141 nobody reads the output.
    """
    return framework.run(app, arguments)
